r"""Fresh particles of a block's posterior: drawn, weighed, resampled, moved.

Particles are drawn from the mixture q, weighed by the posterior over q, resampled and
moved, and a component of the mixture is fitted to where they stand. Where those that
were drawn count for too few, all of this is done again with the new mixture (population
Monte Carlo: Cappé et al. 2004). The mean weight of the last draws estimates the
evidence. Where particles follow a posterior that is nearly this one, they take the
place of the first draws, weighed by the ratio of the two.
One compiled function, in which the likelihood is compiled once for each use of it.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, IntScalar, Key
from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.core.random_numbers import draw_noise
from boomdp_jax.inference.online.likelihood import tally_of, track_points
from boomdp_jax.inference.online.moves import (
    NUM_PARTS,
    effective_sample_size,
    fit_mixture,
    log_densities,
    move_particles,
    resample,
)
from boomdp_jax.inference.online.state import BlockBelief, ParticleSet
from boomdp_jax.inference.samplers.importance_evidence import (
    ImportanceDraws,
    draws_of_noise,
)

# Rounds end where particles count for this share of their number: of fifteen
# coordinates, some on ridges, a mixture of this kind gives hardly ever a tenth.
_ENOUGH = 0.06
_MOST_ROUNDS = 6
# Share of the draws that is spread evenly over structures.
_EVEN_SHARE = 0.2
# Pairs of a jump and a walk of every particle: in every round, in one of particles that
# were near, and in the last one.
_NUM_PAIRS, _NEAR_PAIRS, _LAST_PAIRS = 1, 2, 8


class Renewed(NamedTuple):
    """A belief with fresh particles."""

    block: BlockBelief
    log_evidence: FloatScalar
    """Of all rows, structures and noise averaged over; NaN where the last particles
    were not drawn but kept, whose density is known up to a factor."""
    effective_sample_size: FloatScalar
    """Of the last weights."""
    num_rounds: IntScalar


@QuickCompile
def near_log_proposal(block: BlockBelief) -> Float[Array, " particle"]:
    """Log-density that a belief's particles were drawn from, weights included."""
    particles = block.particles
    structure, z, square = particles.structure, particles.z, particles.square
    num = particles.log_weight.shape[0]
    found = log_densities(block, structure, z, square)
    return found - particles.log_weight - jnp.log(num)


@QuickCompile
def renew(
    key: Key,
    block: BlockBelief,
    end: IntScalar,
    is_near: BoolScalar,
    log_proposal: Float[Array, " particle"],
) -> Renewed:
    """Draw the particles of a block anew.

    Args:
        key: random key.
        block: with target and mixture; its particles are replaced.
        end: rows in use.
        is_near: whether the particles that it has are near the posterior, and the first
            to be weighed.
        log_proposal: density that these were drawn from.
    """
    num = block.particles.log_weight.shape[0]
    block = eqx.tree_at(lambda b: b.tally, block, tally_of(block.target))
    mixture = jax.lax.cond(is_near, fit_mixture, lambda b: b.mixture, block)
    block = eqx.tree_at(lambda b: b.mixture, block, mixture)

    def once(carry: tuple[Key, Renewed]) -> tuple[Key, Renewed]:
        key, before = carry
        key, draw_key, resample_key, move_key = jax.random.split(key, 4)
        is_kept = is_near & (before.num_rounds == 0)
        block, log_evidence = _weighed(
            draw_key, before.block, end, is_kept, log_proposal
        )
        size = effective_sample_size(block.particles.log_weight)
        particles = resample(resample_key, block.particles)
        block = eqx.tree_at(lambda b: b.particles, block, particles)
        is_over = size >= _ENOUGH * num
        is_over = is_over | (before.num_rounds + 1 == _MOST_ROUNDS)
        pairs = jnp.where(is_kept, _NEAR_PAIRS, _LAST_PAIRS)
        pairs = jnp.where(is_over, pairs, _NUM_PAIRS)
        block = move_particles(move_key, block, end, 2 * NUM_PARTS * pairs).block
        block = eqx.tree_at(lambda b: b.mixture, block, fit_mixture(block))
        log_evidence = jnp.where(is_kept, jnp.nan, log_evidence)
        return key, Renewed(block, log_evidence, size, before.num_rounds + 1)

    def is_going_on(carry: tuple[Key, Renewed]) -> BoolScalar:
        found = carry[1]
        is_few = found.effective_sample_size < _ENOUGH * num
        return is_few & (found.num_rounds < _MOST_ROUNDS)

    dtype = block.particles.log_weight.dtype
    start = Renewed(block, jnp.zeros((), dtype), jnp.zeros((), dtype), jnp.asarray(0))
    return jax.lax.while_loop(is_going_on, once, (key, start))[1]


def _weighed(
    key: Key,
    block: BlockBelief,
    end: IntScalar,
    is_kept: BoolScalar,
    log_proposal: Float[Array, " particle"],
):
    """Particles drawn from the mixture, or kept, with weights, and their mean's log.

    Components are drawn in order, and `move_particles` takes every fourth particle.
    """
    target, mixture, old = block.target, block.mixture, block.particles
    num = old.log_weight.shape[0]
    kept = ImportanceDraws(old.structure, old.z, log_proposal, jnp.ones(num, bool))

    def draw() -> ImportanceDraws:
        offset_key, noise_key = jax.random.split(key)
        keys = jax.random.split(noise_key, num)
        dof = mixture.degrees_of_freedom
        noise = jax.vmap(lambda key: draw_noise(key, target.dim, dof))(keys)
        offset = jax.random.uniform(offset_key)
        return draws_of_noise(offset, noise, target, mixture, even_share=_EVEN_SHARE)

    points = jax.lax.cond(is_kept, lambda: kept, draw)
    structure, z = points.structure, points.z
    mean, square = track_points(target, structure, z, block.begin, end)
    log_density = log_densities(block, structure, z, square)
    log_weight = log_density - points.log_proposal
    is_possible = points.is_inside & (log_density < jnp.inf) & ~jnp.isnan(log_weight)
    log_weight = jnp.where(is_possible, log_weight, -1e30)
    total = logsumexp(log_weight)
    log_weight = (log_weight - total).astype(old.log_weight.dtype)
    particles = ParticleSet(structure, z, log_weight, mean, square)
    block = eqx.tree_at(lambda b: b.particles, block, particles)
    return block, total - jnp.log(num)
