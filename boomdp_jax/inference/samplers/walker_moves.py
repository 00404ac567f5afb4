"""One move of every walker of every object: proposals, likelihoods and verdicts.

A proposal is made for all walkers by one compiled program, evaluated by the caller, and
decided by another: whatever path of densities a sampler follows, the physics is
compiled once.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.one_by_one import one_by_one
from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.core.random_numbers import Noise, pick
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.draw_moves import walk_share
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.samplers.moves import (
    MOVES,
    MoveInfo,
    Point,
    Proposal,
    accept,
    propose_change,
    propose_walk,
)
from boomdp_jax.inference.samplers.weighing import batch_noise

_PRIOR_SHARE = 0.3


class MoveCounts(NamedTuple):
    """Proposals made and accepted, `[object, move, 2]`; see `structure_chain`."""

    proposed: np.ndarray
    accepted: np.ndarray


@QuickCompile
def log_proposal_of(targets, mixtures, structure, z):
    """Log-densities of the mixtures at as many points of every object."""

    def one(target, mixture, structure, z):
        return jax.vmap(lambda k, z: mixture.log_density(target, k, z))(structure, z)

    return one_by_one(one, targets, mixtures, structure, z)


class Batch(NamedTuple):
    """A proposal of every walker, before its likelihood is known."""

    proposal: Proposal
    log_proposal: Float[Array, "object walker"]


@functools.partial(QuickCompile, static=("move",))
def _propose(
    move: str,
    noise: Noise,
    points: Point,
    targets: StructureTarget,
    mixtures: LaplaceMixture,
) -> Batch:
    def one(noise, point, target, mixture):
        if move == "walk":
            size = walk_share(noise.choice[1])
            proposal = propose_walk(noise, point, target, mixture, size)
        elif move == "change":
            proposal = propose_change(noise, point, target, mixture, _PRIOR_SHARE)
        else:
            component = pick(mixture.log_weight, noise.choice[0])
            draw = mixture.sample_component(noise, target, component)
            proposal = Proposal(
                structure=draw.structure,
                z=draw.z,
                log_correction=point.log_proposal,
                is_valid=draw.is_inside,
                is_made=jnp.asarray(True),
            )
        log_proposal = mixture.log_density(target, proposal.structure, proposal.z)
        if move == "jump":
            correction = proposal.log_correction - log_proposal
            proposal = proposal._replace(log_correction=correction)
        return Batch(proposal, log_proposal)

    return one_by_one(
        jax.vmap(one, (0, 0, None, None)), noise, points, targets, mixtures
    )


@QuickCompile
def _decide(
    points: Point, batch: Batch, log_density, uniform
) -> tuple[Point, MoveInfo]:
    def one(point, batch, log_density, uniform):
        proposal = batch.proposal
        is_valid = proposal.is_valid & proposal.is_made & (log_density < jnp.inf)
        candidate = Point(
            structure=proposal.structure,
            z=proposal.z,
            log_density=jnp.where(is_valid, log_density, -jnp.inf),
            log_proposal=batch.log_proposal,
        )
        moved, info = accept(uniform, point, candidate, proposal.log_correction)
        return moved, info._replace(is_made=proposal.is_made)

    return jax.vmap(jax.vmap(one))(points, batch, log_density, uniform)


def propose_all(
    move: str,
    rng: np.random.Generator,
    points: Point,
    targets: StructureTarget,
    mixtures: LaplaceMixture,
) -> Batch:
    """A proposal of every walker."""
    noise = batch_noise(rng, targets, mixtures, points.structure.shape[1])
    return _propose(move, noise, points, targets, mixtures)


def decide_all(
    rng: np.random.Generator,
    points: Point,
    batch: Batch,
    log_density: Float[Array, "object walker"],
) -> tuple[Point, MoveInfo]:
    """Accept or refuse every proposal, given the log-density that is sampled there."""
    dtype = points.z.dtype
    # Which choices a proposal makes is its own affair; the verdict gets a fresh number.
    uniform = on_device(1.0 - rng.random(points.structure.shape), dtype)
    return _decide(points, batch, log_density.astype(dtype), uniform)


def no_moves(num_objects: int) -> MoveCounts:
    """Counts to begin with."""
    shape = (num_objects, len(MOVES), 2)
    return MoveCounts(np.zeros(shape, int), np.zeros(shape, int))


def count_moves(
    counts: MoveCounts, move: str, info: MoveInfo, is_asked: np.ndarray | None = None
) -> None:
    """Add the outcomes of one move to the counts, in place.

    Args:
        counts: to add to.
        move: its name.
        info: outcomes of all walkers of all objects.
        is_asked: objects whose moves count; None: all.
    """
    index = MOVES.index(move)
    is_made, is_taken = np.asarray(info.is_made), np.asarray(info.accepted)
    if is_asked is not None:
        is_made = is_made & is_asked[:, None]
    changes = np.asarray(info.changes_structure)
    for column, mask in enumerate((~changes, changes)):
        counts.proposed[:, index, column] += np.sum(is_made & mask, axis=1)
        counts.accepted[:, index, column] += np.sum(is_made & is_taken & mask, axis=1)
