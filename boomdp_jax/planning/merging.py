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
        The nodes, and where each child points to.
    """
    number = jnp.arange(score.shape[0])
    order = _ascending(score)
    leader = _best_of_group(cell, order, exists)
    is_leader = exists & (leader == number)
    if policy == "stratified":
        priority = _in_turn(stratum, order, is_leader, score, capacity)
    else:
        priority = _priority(key, policy, number, score)
    best, child = lax.top_k(jnp.where(is_leader, priority, -jnp.inf), capacity)
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


def _ascending(score: Float[Array, " child"]) -> UInt32[Array, " child"]:
    """Unsigned numbers in the order of the scores, for scatters to take the largest."""
    bits = lax.bitcast_convert_type(score.astype(jnp.float32), jnp.uint32)
    return jnp.where(bits >> 31 == 1, ~bits, bits | jnp.uint32(0x80000000))


def _best_of_group(
    cell: Int[Array, "child channel"],
    order: UInt32[Array, " child"],
    exists: Bool[Array, " child"],
) -> Int[Array, " child"]:
    """The best child of the same cell as each; the first one, where scores are equal.

    By hash tables instead of sorting, which takes several times as long: the best
    child of each slot wins it, those of its cell are done, and those that met another
    cell in their slot go on to a table with other slots.
    """
    num = order.shape[0]
    # Twice the slots that are needed, so that four fifths are done after one table.
    num_bits = (2 * num - 1).bit_length()
    mixed = hash_of(cell)

    def one_table(carry):
        leader, is_left, factor = carry
        slot = ((mixed * factor) >> (32 - num_bits)).astype(jnp.int32)
        winner = _best_of_slot(slot, order, is_left, 1 << num_bits)[slot]
        is_found = is_left & jnp.all(cell == cell[winner], axis=1)
        leader = jnp.where(is_found, winner, leader)
        return leader, is_left & ~is_found, factor * _FACTOR

    # Each table does one cell at least, so that there is an end even to equal hashes.
    carry = (jnp.arange(num), exists, _FACTOR)
    return lax.while_loop(lambda carry: jnp.any(carry[1]), one_table, carry)[0]


# Odd, and near the golden section of 2³²: products of its powers are well spread.
_FACTOR = jnp.uint32(0x9E3779B1)


def _best_of_slot(
    slot: Int[Array, " child"],
    order: UInt32[Array, " child"],
    is_in: Bool[Array, " child"],
    num_slots: int,
) -> Int[Array, " slot"]:
    """The first of the best children in each slot; of no meaning in an empty one."""
    num = order.shape[0]
    where = jnp.where(is_in, slot, num_slots)
    best = jnp.zeros(num_slots, jnp.uint32).at[where].max(order, mode="drop")
    where = jnp.where(best[slot] == order, where, num_slots)
    first = jnp.full(num_slots, num - 1)
    return first.at[where].min(jnp.arange(num), mode="drop")


def _in_turn(
    stratum: Int[Array, "child channel"],
    order: UInt32[Array, " child"],
    is_leader: Bool[Array, " child"],
    score: Float[Array, " child"],
    capacity: int,
) -> Float[Array, " child"]:
    """Priorities: all that were chosen before the last turn, then its own by score."""
    number = jnp.arange(order.shape[0])
    # There is nothing to choose where all have room.
    is_room = jnp.sum(is_leader) <= capacity
    group = _best_of_group(stratum, order, is_leader & ~is_room)
    num_wanted = jnp.minimum(capacity, jnp.sum(is_leader))

    def one_turn(carry):
        chosen, _ = carry
        is_left = is_leader & ~chosen
        best = _best_of_slot(group, order, is_left, number.shape[0])
        return chosen | (is_left & (best[group] == number)), chosen

    first = is_leader & (is_room | (group == number))
    chosen, before = lax.while_loop(
        lambda carry: jnp.sum(carry[0]) < num_wanted,
        one_turn,
        (first, jnp.zeros_like(first)),
    )
    return jnp.where(before, jnp.inf, jnp.where(chosen, score, -jnp.inf))


def _priority(
    key: Key, policy: str, number: Int[Array, " child"], score: Float[Array, " child"]
) -> Float[Array, " child"]:
    """Priorities of the other policies."""
    if policy == "bound":
        return score
    if policy == "first":
        return -number.astype(score.dtype)
    if policy == "random":
        return jax.random.uniform(key, score.shape)
    spread = jnp.std(score, where=jnp.isfinite(score))
    return score / jnp.maximum(spread, 1e-12) + jax.random.gumbel(key, score.shape)
