r"""Four Metropolis moves over structures and coordinates, each exact on its own.

With target $p$, mixture $q$, and $K$ a kernel that leaves $q$ reversible,

- **jump** proposes from $q$ and accepts with $p(x') q(x) / (p(x) q(x'))$: birth, death
  and change of kind at once. Births fill the coordinates that deaths leave at zero, so
  the Jacobian is one.
- **change** toggles or swaps one slot, keeps all other coordinates and draws the new
  block from what `slot_conditional` says: the local reversible jump of Green (1995).
- **walk** stays in the structure and proposes from a Crank-Nicolson step $K$ about a
  Student component; accepted with the same ratio as a jump. It needs no gradient and
  is nearly always accepted where the mixture is good, at any step size. Kamatani
  (2018), Efficient strategy for the MCMC in high dimension (mixed preconditioned
  Crank-Nicolson).
- **leap** stays in the structure and follows the gradient for a few leapfrog steps,
  preconditioned by the heaviest component. Worth its price, some ten likelihoods a
  step, only where the mixture is poor.

A proposal is made without a likelihood and decided with one, so that a caller can
choose among proposals and still compile the likelihood once.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, IntScalar, Key
from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.core.random_numbers import Noise, pick
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture, is_in_cell
from boomdp_jax.inference.samplers.slot_conditional import sample_slot, slot_log_density

MOVES = ("jump", "change", "walk", "leap")
"""Names of the moves, in the order in which counts list them."""


class Point(eqx.Module):
    """Structures with coordinates, one or many, and both log-densities there."""

    structure: Int[Array, "*batch"]
    z: Float[Array, "*batch dim"]
    log_density: Float[Array, "*batch"]
    """Of the target; minus infinity marks a proposal that cannot be accepted."""
    log_proposal: Float[Array, "*batch"]
    """Of the mixture."""


class Proposal(NamedTuple):
    """Where to go, and the part of the acceptance ratio that is not the target's."""

    structure: IntScalar
    z: Float[Array, " dim"]
    log_correction: FloatScalar
    """Log of backward over forward proposal density."""
    is_valid: BoolScalar
    """False where a proposal fell outside; it counts as made, and is refused."""
    is_made: BoolScalar
    """False where there was nothing to propose."""


class MoveInfo(NamedTuple):
    """What became of one proposal."""

    is_made: BoolScalar
    accepted: BoolScalar
    changes_structure: BoolScalar
    accept_probability: FloatScalar


def evaluate(
    target: StructureTarget,
    mixture: LaplaceMixture,
    structure: IntScalar,
    z: Float[Array, " dim"],
    is_valid: BoolScalar | bool = True,
) -> Point:
    """Log-densities of a structure with coordinates; one likelihood.

    A log-density that is not a number, or is plus infinity, counts as minus infinity.
    """
    log_density = target.log_density(structure, z)
    is_valid = is_valid & (log_density < jnp.inf)
    return Point(
        structure=structure,
        z=z,
        log_density=jnp.where(is_valid, log_density, -jnp.inf),
        log_proposal=mixture.log_density(target, structure, z),
    )


def propose_jump(key: Key, target: StructureTarget, mixture: LaplaceMixture) -> Point:
    """Draw from the mixture; does not depend on where a chain stands."""
    draw = mixture.sample(key, target)
    return evaluate(target, mixture, draw.structure, draw.z, draw.is_inside)


def jump(
    uniform: FloatScalar, point: Point, candidate: Point
) -> tuple[Point, MoveInfo]:
    """Accept or refuse an independent proposal, given a number uniform over (0, 1)."""
    log_correction = point.log_proposal - candidate.log_proposal
    return accept(uniform, point, candidate, log_correction)


def propose_change(
    noise: Noise,
    point: Point,
    target: StructureTarget,
    mixture: LaplaceMixture,
    prior_share: float,
) -> Proposal:
    """Propose a birth, a death or a change of kind of one slot.

    A neighbour is chosen evenly among all structures that differ in one slot, or in one
    slot swapped for another.
    """
    near = neighbours(target, point.structure)
    structure = pick(jnp.where(near, 0.0, -jnp.inf), noise.choice[2])
    before, after = target.in_use(point.structure), target.in_use(structure)
    born, dead = after & ~before, before & ~after
    kept = jnp.where(before & after, point.z, 0.0)
    z, is_inside = sample_slot(
        noise, target, mixture, structure, kept, born, prior_share
    )
    forward = slot_log_density(target, mixture, structure, z, born, prior_share)
    backward = slot_log_density(
        target, mixture, point.structure, point.z, dead, prior_share
    )
    num_forward = jnp.sum(near)
    num_backward = jnp.sum(neighbours(target, structure))
    rates = jnp.log(num_forward) - jnp.log(num_backward)
    is_made = jnp.any(near)
    return Proposal(structure, z, backward - forward + rates, is_inside, is_made)


def neighbours(
    target: StructureTarget, structure: IntScalar
) -> Bool[Array, " structure"]:
    """Structures of positive prior that are one birth, death or swap away."""
    active = target.structures[structure]
    num_born = jnp.sum(target.structures & ~active[None], axis=-1)
    num_dead = jnp.sum(~target.structures & active[None], axis=-1)
    is_near = (num_born <= 1) & (num_dead <= 1) & (num_born + num_dead > 0)
    return is_near & (target.log_prior > -jnp.inf)


@full_precision
def propose_walk(
    noise: Noise,
    point: Point,
    target: StructureTarget,
    mixture: LaplaceMixture,
    step_size: FloatScalar,
) -> Proposal:
    r"""Propose a Crank-Nicolson step about a component chosen by responsibility.

    With the Student's own scale $\lambda$ drawn given $z$ and a step $s \in (0, 1]$,
    $z' = m + \sqrt{1 - s^2} (z - m) + s \lambda^{-1/2} L \xi$, which leaves that
    component reversible, and so does drawing the component anew leave the mixture.
    Coordinates from the prior move likewise about zero, angles by a uniform step.
    """
    mixture = mixture.of_structure(point.structure)
    each = mixture.component_log_density(target, point.structure, point.z)
    component = pick(each, noise.choice[0])
    is_student = mixture.is_student[component]
    offset = mixture.offset(target, point.z)[component]
    distance = jnp.sum((mixture.whitening[component] @ offset) ** 2)
    nu = mixture.degrees_of_freedom
    chi_square = noise.chi_square(nu + jnp.sum(is_student))
    spread = jnp.sqrt((nu + distance) / chi_square)
    keep = jnp.sqrt(1.0 - step_size**2)
    kick = mixture.scale_tril[component] @ jnp.where(is_student, noise.normal, 0.0)
    moved = keep * offset + step_size * spread * kick
    free = jnp.where(
        target.period > 0,
        point.z + step_size * target.period * noise.turn,
        keep * point.z + step_size * noise.normal,
    )
    free = jnp.where(mixture.from_prior[component], free, 0.0)
    z = target.wrap(jnp.where(is_student, mixture.mean[component] + moved, free))
    return Proposal(
        structure=point.structure,
        z=z,
        log_correction=point.log_proposal
        - mixture.log_density(target, point.structure, z),
        is_valid=is_in_cell(target, moved, is_student),
        is_made=mixture.has_structure(point.structure),
    )


def decide(
    uniform: FloatScalar,
    point: Point,
    target: StructureTarget,
    mixture: LaplaceMixture,
    proposal: Proposal,
) -> tuple[Point, MoveInfo]:
    """Evaluate a proposal and accept or refuse it; one likelihood."""
    is_valid = proposal.is_valid & proposal.is_made
    candidate = evaluate(target, mixture, proposal.structure, proposal.z, is_valid)
    moved, info = accept(uniform, point, candidate, proposal.log_correction)
    return moved, info._replace(is_made=proposal.is_made)


@full_precision
def leap(
    key: Key,
    point: Point,
    target: StructureTarget,
    mixture: LaplaceMixture,
    step_size: FloatScalar,
    num_leapfrog: int,
) -> tuple[Point, MoveInfo]:
    """Go to the end of a short Hamiltonian path, whitened by the heaviest component.

    Which component that is depends on the structure alone, so the metric is constant
    along the path. The gradient is taken at wrapped angles: the path then runs on the
    circle, and is reversible even if the likelihood is not the same across the seam.
    """
    momentum_key, accept_key = jax.random.split(key)
    in_use = target.in_use(point.structure)
    weight = jnp.where(
        mixture.structure == point.structure, mixture.log_weight, -jnp.inf
    )
    metric = mixture.scale_tril[jnp.argmax(weight)]
    has_component = mixture.has_structure(point.structure)
    metric = jnp.where(has_component, metric, jnp.eye(target.dim))
    metric = jnp.where(in_use[:, None] & in_use[None, :], metric, 0.0)

    def slope(z: Array) -> Array:
        gradient = jax.grad(lambda z: target.log_density(point.structure, z))(
            target.wrap(z)
        )
        return metric.T @ jnp.where(in_use, gradient, 0.0)

    def leapfrog(carry: tuple, _: None) -> tuple[tuple, None]:
        z, momentum = carry
        middle = z + 0.5 * step_size * (metric @ momentum)
        momentum = momentum + step_size * slope(middle)
        return (middle + 0.5 * step_size * (metric @ momentum), momentum), None

    start = jnp.where(in_use, jax.random.normal(momentum_key, (target.dim,)), 0.0)
    (z, momentum), _ = jax.lax.scan(
        leapfrog, (point.z, start), None, length=num_leapfrog
    )
    candidate = evaluate(target, mixture, point.structure, target.wrap(z))
    kinetic = 0.5 * jnp.sum((start - momentum) * (start + momentum))
    uniform = jax.random.uniform(accept_key, dtype=point.log_density.dtype)
    return accept(uniform, point, candidate, kinetic)


def accept(
    uniform: FloatScalar, point: Point, candidate: Point, log_correction: FloatScalar
) -> tuple[Point, MoveInfo]:
    """Take the candidate with probability min(1, ratio); a NaN ratio refuses."""
    log_ratio = candidate.log_density - point.log_density + log_correction
    is_possible = (candidate.log_density > -jnp.inf) & ~jnp.isnan(log_ratio)
    log_ratio = jnp.where(is_possible, log_ratio, -jnp.inf)
    accepted = jnp.log(uniform) < log_ratio
    moved = jax.tree.map(lambda a, b: jnp.where(accepted, a, b), candidate, point)
    return moved, MoveInfo(
        is_made=jnp.asarray(True),
        accepted=accepted,
        changes_structure=candidate.structure != point.structure,
        accept_probability=jnp.exp(jnp.minimum(log_ratio, 0.0)),
    )
