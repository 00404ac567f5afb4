"""One transition into the belief about a whole scene: the table, and every block."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, IntScalar
from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.inference.online.rows import append_row, can_happen, new_row, shift_rows
from boomdp_jax.inference.online.state import BeliefState
from boomdp_jax.inference.online.step import (
    ALARM,
    FIRST_TEST,
    BlockInfo,
    drop_block_rows,
    refresh_block,
)

LEAVING_SHARE = 8
"""One part in so many of a full table leaves at once: each time, all particles have to
be weighed anew by all rows."""

# With fewer particles in effect than this number, or than this share, a belief has lost
# its way.
_FEWEST, _FEWEST_SHARE = 8.0, 1.0 / 64.0


class OnlineInfo(NamedTuple):
    """What one transition did to a belief; a pytree."""

    blocks: BlockInfo
    """With a leading axis `block`, in the order of `OnlineBelief.blocks`."""
    needs_refit: BoolScalar
    """For one of the three reasons below, the first two of which wait while readings
    have been odd for too few rows to look for a change."""
    is_stale: BoolScalar
    """The table has grown by half, or been half renewed, since the last refit."""
    is_degenerate: Bool[Array, " block"]
    """Next to no particle agrees with the readings, or all are copies of a few."""
    is_surprised: Bool[Array, " block"]
    """Readings have looked unlike what was expected for several rows."""
    is_finite: BoolScalar
    """False where the wrench was not, or the length not that of a step: the transition
    told nothing."""
    num_rows: IntScalar
    """Rows in the table after the step."""
    num_left: IntScalar
    """Oldest rows that left a full table in this step."""


@functools.lru_cache(maxsize=64)
def compiled_refresh(
    groups: tuple[tuple[tuple[int, ...], ...], ...], forgetting: float
) -> QuickCompile:
    """`refresh` of blocks by groups; beliefs of equal shapes share its programs."""
    return QuickCompile(functools.partial(refresh, groups, forgetting))


def refresh(
    groups: tuple[tuple[tuple[int, ...], ...], ...],
    forgetting: float,
    belief: BeliefState,
    state: Float[Array, "body 6"],
    wrench: Float[Array, "body 3"],
    next_state: Float[Array, "body 6"],
    dt: FloatScalar,
    starts_episode: BoolScalar,
) -> tuple[BeliefState, OnlineInfo]:
    """Take one transition in.

    Args:
        groups: bodies of the blocks of each entry of `BeliefState.blocks`.
        forgetting: factor on the weight of all rows before.
        belief: so far.
        state: reading before the step.
        wrench: held over it.
        next_state: reading after the step.
        dt: length of the step [s].
        starts_episode: whether bodies were moved between the last row and this one.

    Returns:
        The belief, and what happened.
    """
    capacity = belief.history.capacity
    num_left = capacity // LEAVING_SHARE
    is_full = belief.num_rows >= capacity
    belief = jax.lax.cond(
        is_full, lambda b: _without_oldest(b, num_left), lambda b: b, belief
    )
    index = belief.num_rows
    new = new_row(belief.history, index, state, wrench, next_state, dt, starts_episode)
    key, step_key = jax.random.split(belief.key)
    blocks, infos = [], []
    for number, (group, stacked) in enumerate(zip(groups, belief.blocks, strict=True)):
        keys = jax.random.split(jax.random.fold_in(step_key, number), len(group))
        block, info = _map_members(
            lambda key, block, bodies: refresh_block(
                key, block, new, bodies, index, is_full, forgetting
            ),
            (keys, stacked, jnp.asarray(group)),
        )
        blocks.append(block)
        infos.append(info)
    info = jax.tree.map(lambda *parts: jnp.concatenate(parts), *infos)
    num_seen = belief.num_seen + 1
    num_particles = belief.blocks[0].particles.log_weight.shape[-1]
    fewest = max(_FEWEST, _FEWEST_SHARE * num_particles)
    is_degenerate = info.distinct_sample_size < fewest
    is_degenerate = is_degenerate & (num_seen >= belief.refit_after)
    is_stale = num_seen >= belief.refit_at
    # Where odd readings are too few yet to look for a change, a fit would take two
    # worlds for one, and the noise for large enough to hide it.
    num_odd = index + 1 - info.surprised_since
    is_early = (info.log_surprise > 0) & (num_odd < FIRST_TEST)
    is_alarmed = (info.log_surprise > ALARM) & ~info.is_surprised
    is_waiting = jnp.any(is_early | is_alarmed)
    is_due = (is_stale | jnp.any(is_degenerate)) & ~is_waiting
    belief = BeliefState(
        key=key,
        history=append_row(belief.history, index, new),
        num_rows=index + 1,
        num_seen=num_seen,
        refit_at=belief.refit_at,
        refit_after=belief.refit_after,
        blocks=tuple(blocks),
    )
    return belief, OnlineInfo(
        blocks=info,
        needs_refit=is_due | jnp.any(info.is_surprised),
        is_stale=is_stale,
        is_degenerate=is_degenerate,
        is_surprised=info.is_surprised,
        is_finite=can_happen(wrench, dt),
        num_rows=index + 1,
        num_left=jnp.where(is_full, num_left, 0),
    )


def _without_oldest(belief: BeliefState, num: int) -> BeliefState:
    """A full table without its oldest rows."""
    blocks = tuple(
        _map_members(lambda block: drop_block_rows(block, num), (stacked,))
        for stacked in belief.blocks
    )
    history = shift_rows(belief.history, num)
    return eqx.tree_at(
        lambda s: (s.blocks, s.history, s.num_rows),
        belief,
        (blocks, history, belief.num_rows - num),
    )


def _map_members(function: Callable[..., Any], members: tuple) -> Any:
    """A function of each member of a group, one after the other.

    Not side by side: what is done under a condition would then be done always. A loop
    around a single member would only cost compile time.
    """
    if jax.tree.leaves(members)[0].shape[0] > 1:
        return jax.lax.map(lambda member: function(*member), members)
    found = function(*jax.tree.map(lambda leaf: leaf[0], members))
    return jax.tree.map(lambda leaf: leaf[None], found)
