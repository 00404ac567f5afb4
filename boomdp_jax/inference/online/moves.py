"""Keeping particles apart: resampling, a mixture fitted to them, and moves with it.

Each move proposes for one part of the particles, by a jump between structures and next
time round by a walk within them (`moves`), and takes the verdict with the likelihood of
all rows. A move leaves the posterior as it is, so weighted particles stay properly
weighted (Gilks and Berzuini 2001, Following a moving target). That the mixture is
fitted to the same particles that then move costs a bias of the order of one over their
number, as in any adaptive sequential sampler.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float, Int

from boomdp_jax.core.arrays import FloatScalar, IntScalar, Key
from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.core.random_numbers import Noise, draw_noise, pick
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.online.likelihood import (
    levels_of,
    log_likelihoods,
    track_points,
)
from boomdp_jax.inference.online.state import BlockBelief, ParticleSet
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture, make_mixture
from boomdp_jax.inference.samplers.moves import Point, Proposal, accept, propose_walk

NUM_PARTS = 4
"""Parts of the particles that move in turn."""

_WALK_ACCEPT, _WALK_GAIN = 0.4, 0.3
# Share of a structure's weight that the component fitted to its particles gets, if the
# particles count for so many per coordinate; and share of the structures' weights that
# follows the particles.
_SPARE_SHARE, _DRAWS_PER_DIM, _PARTICLE_SHARE = 0.6, 2.0, 0.7


class MoveResult(NamedTuple):
    """Where a block's particles are after a number of moves."""

    block: BlockBelief
    num_accepted: FloatScalar
    num_proposed: FloatScalar


def effective_sample_size(log_weight: Float[Array, " particle"]) -> FloatScalar:
    """Kish's, of normalised log-weights."""
    return jnp.exp(-logsumexp(2.0 * log_weight))


def distinct_sample_size(particles: ParticleSet) -> FloatScalar:
    """Kish's number where copies of a particle, as resampling makes them, are one.

    Equal weights say nothing of a cloud that was drawn from two particles.

    Args:
        particles: with normalised log-weights.
    """
    num, dim = particles.z.shape
    # Equal particles have equal sums, and others of their structure hardly ever have.
    factor = jnp.sqrt(jnp.arange(2.0, 2.0 + dim, dtype=particles.z.dtype))
    name, structure = jnp.sum(particles.z * factor[None], axis=1), particles.structure
    order = jnp.lexsort((name, structure))
    is_new = (jnp.diff(name[order]) != 0) | (jnp.diff(structure[order]) != 0)
    copy = jnp.cumsum(jnp.concatenate([jnp.zeros(1, bool), is_new]))
    weight = jnp.exp(particles.log_weight)[order]
    whole = jax.ops.segment_sum(weight, copy, num, indices_are_sorted=True)
    return jnp.sum(weight) ** 2 / jnp.sum(whole**2)


def resample(key: Key, particles: ParticleSet) -> ParticleSet:
    """Draw particles by weight, systematically (Kitagawa 1996), to equal weights."""
    num = particles.log_weight.shape[0]
    total = jnp.cumsum(jnp.exp(particles.log_weight))
    level = (jnp.arange(num) + jax.random.uniform(key, dtype=total.dtype)) / num
    rows = jnp.searchsorted(total / total[-1], level.astype(total.dtype), side="right")
    chosen = jax.tree.map(lambda leaf: leaf[jnp.minimum(rows, num - 1)], particles)
    equal = jnp.full_like(particles.log_weight, -jnp.log(num))
    return eqx.tree_at(lambda p: p.log_weight, chosen, equal)


def fit_mixture(block: BlockBelief) -> LaplaceMixture:
    """Fit one component of each structure, and the structures' weights, to particles.

    Args:
        block: whose mixture's last components, one a structure, are free to be fitted.
    """
    target, mixture, particles = block.target, block.mixture, block.particles
    num = target.num_structures
    weight = jnp.exp(particles.log_weight)
    is_mine = particles.structure[None] == jnp.arange(num)[:, None]
    of_each = jnp.where(is_mine, weight[None], 0.0)
    mean, scale_tril, is_used = jax.vmap(
        lambda w, k: _moments(target, particles, w, k)
    )(of_each, jnp.arange(num))
    structure = mixture.structure
    is_spare = jnp.arange(structure.shape[0]) >= structure.shape[0] - num
    base = jnp.where(is_spare, -jnp.inf, block.base_log_weight)
    is_member = structure[None] == jnp.arange(num)[:, None]
    whole = logsumexp(jnp.where(is_member, base[None], -jnp.inf), axis=1)
    whole = whole - logsumexp(whole)
    within = base - whole[structure]
    share = jnp.where(is_used, _SPARE_SHARE, 0.0)
    within = jnp.where(
        is_spare, jnp.log(share)[structure], within + jnp.log1p(-share)[structure]
    )
    mixed = (1.0 - _PARTICLE_SHARE) * jnp.exp(whole)
    mixed = mixed + _PARTICLE_SHARE * jnp.sum(of_each, axis=1)
    return make_mixture(
        target,
        structure,
        mixture.mean.at[-num:].set(mean),
        mixture.scale_tril.at[-num:].set(scale_tril),
        within + jnp.log(mixed)[structure],
        from_prior=mixture.from_prior,
        degrees_of_freedom=mixture.degrees_of_freedom,
        most_each=mixture.most_each,
    )


@full_precision
def _moments(
    target: StructureTarget,
    particles: ParticleSet,
    weight: Float[Array, " particle"],
    structure: IntScalar,
):
    """Mean and Cholesky factor of a structure's particles, and whether they are enough.

    Angles are taken about the heaviest particle.
    """
    total = jnp.sum(weight)
    share = weight / jnp.where(total > 0, total, 1.0)
    heaviest = particles.z[jnp.argmax(weight)]
    offset = jax.vmap(target.wrap)(particles.z - heaviest[None])
    middle = share @ offset
    centred = offset - middle[None]
    covariance = (share[:, None] * centred).T @ centred
    in_use = target.in_use(structure)
    both = in_use[:, None] & in_use[None, :]
    variance = jnp.diagonal(covariance)
    jitter = jnp.where(in_use, 1e-5 * variance + 1e-12, 1.0)
    factor = jnp.linalg.cholesky(jnp.where(both, covariance, 0.0) + jnp.diag(jitter))
    num_effective = 1.0 / jnp.maximum(jnp.sum(share**2), 1e-30)
    is_used = (total > 0) & (num_effective > _DRAWS_PER_DIM * jnp.sum(in_use))
    is_used = is_used & jnp.all(jnp.isfinite(factor))
    factor = jnp.where(is_used, factor, jnp.eye(target.dim))
    return target.wrap(heaviest + middle), factor, is_used


def move_particles(
    key: Key, block: BlockBelief, end: IntScalar, num_moves: IntScalar
) -> MoveResult:
    """Move parts of the particles in turn.

    Args:
        key: random key.
        block: whose target and particles know the same rows.
        end: rows in use.
        num_moves: how often; each costs the likelihood of all rows for one part.
    """

    def once(index: IntScalar, carry: MoveResult) -> MoveResult:
        moved, accepted = _move_part(jax.random.fold_in(key, index), carry.block, end)
        return MoveResult(
            moved,
            carry.num_accepted + jnp.sum(accepted, dtype=carry.num_accepted.dtype),
            carry.num_proposed + accepted.shape[0],
        )

    start = MoveResult(block, jnp.zeros(()), jnp.zeros(()))
    return jax.lax.fori_loop(0, num_moves, once, start)


def _move_part(key: Key, block: BlockBelief, end: IntScalar):
    """One move of every fourth particle."""
    target, mixture = block.target, block.mixture
    number, part = block.num_moves // NUM_PARTS, block.num_moves % NUM_PARTS
    is_walk = number % 2 == 1
    mine: ParticleSet = jax.tree.map(
        lambda leaf: leaf.reshape(-1, NUM_PARTS, *leaf.shape[1:])[:, part],
        block.particles,
    )
    noise_key, verdict_key = jax.random.split(key)
    keys = jax.random.split(noise_key, mine.z.shape[0])
    dof = mixture.degrees_of_freedom
    noise = jax.vmap(lambda key: draw_noise(key, target.dim, dof))(keys)
    points = Point(
        structure=mine.structure,
        z=mine.z,
        log_density=log_densities(block, mine.structure, mine.z, mine.square),
        log_proposal=_log_proposals(block, mine.structure, mine.z),
    )
    proposal = jax.lax.cond(
        is_walk,
        lambda: jax.vmap(
            lambda n, p: propose_walk(n, p, target, mixture, block.step_size)
        )(noise, points),
        lambda: jax.vmap(lambda n, p: _propose_jump(n, p, target, mixture))(
            noise, points
        ),
    )
    mean, square = track_points(
        target, proposal.structure, proposal.z, block.begin, end
    )
    log_density = log_densities(block, proposal.structure, proposal.z, square)
    is_possible = proposal.is_valid & proposal.is_made
    candidates = Point(
        structure=proposal.structure,
        z=proposal.z,
        log_density=jnp.where(is_possible, log_density, -jnp.inf),
        log_proposal=points.log_proposal,
    )
    uniform = jax.random.uniform(
        verdict_key, mine.structure.shape, log_density.dtype, minval=1e-7
    )
    moved, info = jax.vmap(accept)(uniform, points, candidates, proposal.log_correction)
    rate = jnp.mean(info.accept_probability)
    factor = jnp.where(is_walk, jnp.exp(_WALK_GAIN * (rate - _WALK_ACCEPT)), 1.0)

    def choose(after: Array, before: Array) -> Array:
        shape = (-1,) + (1,) * (after.ndim - 1)
        return jnp.where(info.accepted.reshape(shape), after, before)

    found = ParticleSet(
        moved.structure,
        moved.z,
        mine.log_weight,
        choose(mean, mine.mean),
        choose(square, mine.square),
    )

    def put(whole: Array, some: Array) -> Array:
        parts = whole.reshape(-1, NUM_PARTS, *whole.shape[1:])
        return parts.at[:, part].set(some).reshape(whole.shape)

    block = eqx.tree_at(
        lambda b: (b.particles, b.step_size, b.num_moves),
        block,
        (
            jax.tree.map(put, block.particles, found),
            jnp.clip(block.step_size * factor, 0.02, 0.98),
            block.num_moves + 1,
        ),
    )
    return block, info.accepted


def log_densities(
    block: BlockBelief,
    structure: Int[Array, " point"],
    z: Float[Array, "point dim"],
    square: Float[Array, "point body 4"],
) -> Float[Array, " point"]:
    """Log-prior plus log-likelihood of points whose statistics are known."""
    log_prior = jax.vmap(block.target.log_prior_density)(structure, z)
    level = levels_of(block.target, structure, z)
    found = log_likelihoods(block.target, block.tally, level, square)
    return log_prior + jnp.where(found > -1e29, found, -jnp.inf)


def _log_proposals(
    block: BlockBelief, structure: Int[Array, " point"], z: Float[Array, "point dim"]
) -> Float[Array, " point"]:
    mixture = block.mixture
    return jax.vmap(lambda k, z: mixture.log_density(block.target, k, z))(structure, z)


def _propose_jump(
    noise: Noise, point: Point, target: StructureTarget, mixture: LaplaceMixture
) -> Proposal:
    """A draw from the mixture, wherever the particle stands."""
    component = pick(mixture.log_weight, noise.choice[0])
    draw = mixture.sample_component(noise, target, component)
    log_proposal = mixture.log_density(target, draw.structure, draw.z)
    return Proposal(
        structure=draw.structure,
        z=draw.z,
        log_correction=point.log_proposal - log_proposal,
        is_valid=draw.is_inside,
        is_made=jnp.asarray(True),
    )
