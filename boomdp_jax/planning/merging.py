"""Which children become nodes: one of each cell, as many as there is room for.

Children in one cell are represented by the one of the best score; the others point to
it. Where more cells are reached than there are places, a policy says which are kept:

- `"stratified"`: in turn one cell of each stratum, a part of a coarser grid, best
  first. The only one that works where scores mislead: it does not crowd one region.
- `"bound"`: the best scores (beam search); `"gumbel"`: scores with Gumbel noise of
  their own spread; `"random"`; `"first"`, in the order in which they were made.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt32

from boomdp_jax.core.arrays import IntScalar, Key
from boomdp_jax.planning.grid import hash_of

OVERFLOW_POLICIES = ("stratified", "bound", "gumbel", "random", "first")


class Merged(NamedTuple):
    """Children as nodes of the next level."""

    child: Int[Array, " node"]
    """Which child stands at each place."""
    exists: Bool[Array, " node"]
    """False for places that are not taken."""
    place: Int[Array, " child"]
    """Where each child, or who represents it, stands; −1 for nowhere."""
    num_merged: IntScalar
    """Children that another one represents."""
    num_dropped: IntScalar
    """Cells without a place."""


def merge(
    key: Key,
    cell: Int[Array, "child channel"],
    stratum: Int[Array, "child channel"],
    score: Float[Array, " child"],
    exists: Bool[Array, " child"],
    *,
    capacity: int,
    policy: str,
) -> Merged:
    """Choose the nodes of the next level.

    Args:
        key: random key, for the policies that need one.
        cell: of each child.
        stratum: cell of a coarser grid.
        score: what is thought to be had by way of each child.
        exists: whether there is such a child.
        capacity: places, at most as many as children.
        policy: one of `OVERFLOW_POLICIES`.

    Returns:
        The nodes, and where each child points to. Three sorts of the children.
    """
    number = jnp.arange(score.shape[0])
    # Children by score: sorts below are stable, so that the best comes first in each.
    by_score = _sorted(_descending(score, exists), number)[1]

    cell_hash = jnp.where(exists, hash_of(cell), _LAST)
    by_cell = _sorted(cell_hash[by_score], by_score)[1]
    sorted_cell = cell[by_cell]
    # Different cells of one hash stay apart, at worst in more than one piece.
    differs = jnp.any(sorted_cell[1:] != sorted_cell[:-1], axis=1)
    starts = jnp.concatenate([jnp.ones(1, bool), differs]) & exists[by_cell]
    start = lax.cummax(jnp.where(starts, number, 0))
    leader = jnp.zeros_like(number).at[by_cell].set(by_cell[start])
    is_leader = (leader == number) & exists

    # From here on in the order of scores.
    leads = is_leader[by_score]
    if policy == "stratified":
        coarse = jnp.where(leads, hash_of(stratum)[by_score], _LAST)
        priority, rank = _in_turn(coarse, number)
        priority = jnp.where(leads[rank], priority, -jnp.inf)
    else:
        rank = number
        priority = _priority(key, policy, by_score, score[by_score])
        priority = jnp.where(leads, priority, -jnp.inf)
    best, position = lax.top_k(priority, capacity)
    child = by_score[rank[position]]
    is_taken = best > -jnp.inf
    place = jnp.full_like(number, -1)
    place = place.at[jnp.where(is_taken, child, score.shape[0])].set(
        jnp.arange(capacity, dtype=place.dtype), mode="drop"
    )
    num_cells = jnp.sum(is_leader)
    return Merged(
        child,
        is_taken,
        jnp.where(exists, place[leader], -1),
        jnp.sum(exists) - num_cells,
        num_cells - jnp.sum(is_taken),
    )


_LAST = jnp.uint32(0xFFFFFFFF)


def _descending(score: Array, exists: Array) -> UInt32[Array, " child"]:
    """Unsigned numbers in the opposite order of the scores, what is not there last.

    Sorting those is five times as fast on a CPU as sorting floats, whose comparison
    has to mind what is not a number.
    """
    bits = lax.bitcast_convert_type(score.astype(jnp.float32), jnp.uint32)
    is_negative = bits >> 31 == 1
    ascending = jnp.where(is_negative, ~bits, bits | jnp.uint32(0x80000000))
    return jnp.where(exists, ~ascending, _LAST)


def _sorted(keys: UInt32[Array, " child"], values: Int[Array, " child"]):
    return lax.sort((keys, values), num_keys=1, is_stable=True)


def _in_turn(stratum: UInt32[Array, " child"], number: Int[Array, " child"]):
    """Priorities by rank in one's stratum, then by score, and whose each is."""
    sorted_stratum, rank = _sorted(stratum, number)
    is_new = jnp.concatenate(
        [jnp.ones(1, bool), sorted_stratum[1:] != sorted_stratum[:-1]]
    )
    turn = number - lax.cummax(jnp.where(is_new, number, 0))
    turn, place = turn.astype(jnp.float32), rank.astype(jnp.float32)
    return -(turn + place / number.shape[0]), rank


def _priority(key: Key, policy: str, child: Array, score: Array) -> Array:
    """Priorities of children in the order of their scores."""
    if policy == "bound":
        return -jnp.arange(child.shape[0], dtype=jnp.float32)
    if policy == "first":
        return -child.astype(jnp.float32)
    if policy == "random":
        return jax.random.uniform(key, child.shape)
    spread = jnp.std(score, where=jnp.isfinite(score))
    noise = jax.random.gumbel(key, child.shape)
    return (score / jnp.maximum(spread, 1e-12)).astype(jnp.float32) + noise
