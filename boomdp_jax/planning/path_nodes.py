"""Nodes of a search for a path, and which of them are still to be expanded.

Nodes are only ever added. One that a better path to its cell supersedes is closed but
stays where it is, so the path that leads to any node is one that the model walked, with
its continuous states and not only from cell to cell.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from boomdp_jax.core.arrays import FloatScalar, IntScalar
from boomdp_jax.planning.cell_table import CellTable


class Nodes(eqx.Module):
    """States that were reached, and how; of all of them, the first began the search."""

    state: PyTree
    """All leaves have a leading axis `node`."""
    cell: Int[Array, "*node channel"]
    path_return: Float[Array, "*node"]
    """Sum of the rewards on the path, discounted to its beginning."""
    continuation: Float[Array, "*node"]
    """What rewards from here on count by."""
    leaf: Float[Array, "*node"]
    """What is expected from here on."""
    level: Int[Array, "*node"]
    """Actions on the path."""
    parent: Int[Array, "*node"]
    action: Int[Array, "*node"]
    """Index of the last action on the path."""

    def score(self, node: IntScalar) -> FloatScalar:
        """Return to be expected of a path through a node."""
        return self.path_return[node] + self.continuation[node] * self.leaf[node]


class Tally(NamedTuple):
    """What became of children; numbers that only grow."""

    num_merged: IntScalar
    """Children in a cell that was known."""
    num_reopened: IntScalar
    """Of these, those on a better path to a cell that had been expanded."""
    num_overflowed: IntScalar
    """Children for whose cell the table had no room, so that it forgot another one."""


class Target(NamedTuple):
    """A node to go to."""

    node: IntScalar
    merit: FloatScalar
    path_return: FloatScalar

    def better(self, nodes: Nodes, node: IntScalar, merit: FloatScalar) -> "Target":
        """This or another one, by merit and then by the return of the path."""
        path_return = nodes.path_return[node]
        is_tie = (merit == self.merit) & (path_return > self.path_return)
        is_better = (merit > self.merit) | is_tie
        other = Target(node, merit, path_return)
        return jax.tree.map(lambda a, b: jnp.where(is_better, a, b), other, self)


class OpenList(NamedTuple):
    """What is to be expanded, and what tells whether more is."""

    priority: Float[Array, " node"]
    """The score; −∞ for what is not, or no more, to be expanded."""
    table: CellTable
    nearest: Target
    """Of the largest leaf value."""
    tally: Tally

    def put(self, node: Array, priority: Array, is_wanted: Array) -> "OpenList":
        """Open a node, or several."""
        place = jnp.where(is_wanted, node, self.priority.shape[0])
        changed = self.priority.at[place].set(priority, mode="drop")
        return self._replace(priority=changed)

    def close(self, node: Array, is_wanted: Array) -> "OpenList":
        """Take a node, or several, from the list."""
        return self.put(node, jnp.asarray(-jnp.inf, self.priority.dtype), is_wanted)


def admit(
    open_list: OpenList,
    nodes: Nodes,
    children: Int[Array, " child"],
    is_new: Bool[Array, " child"],
    depth: int,
) -> OpenList:
    """Open nodes whose cell is new, or was reached by a worse path only.

    Paths to a cell are compared by their returns; if they differ in length as well, and
    later rewards count less, what is expected beyond the cell is counted on both.

    Args:
        open_list: what is open.
        nodes: all, the children included.
        children: numbers of the children, looked at one after another.
        is_new: False for what only fills up the array.
        depth: level from which on nothing is expanded.

    Returns:
        What is open then.
    """
    # Sums of the same rewards in another order are not a better path.
    rounding = 8.0 * jnp.finfo(nodes.path_return.dtype).eps

    def one(open_list, inputs):
        child, is_new = inputs
        _, table, nearest, tally = open_list
        slot = table.find(nodes.cell, nodes.cell[child])
        old, is_known = slot.node, is_new & (slot.node >= 0)
        gain, beyond, size = (
            nodes.path_return[child] - nodes.path_return[old],
            nodes.continuation[child] - nodes.continuation[old],
            jnp.abs(nodes.path_return[child]) + jnp.abs(nodes.path_return[old]),
        )
        is_gain = gain + beyond * nodes.leaf[child] > rounding * size
        is_kept = is_new & (~is_known | is_gain)
        is_superseded = is_known & is_gain
        is_expanded = jnp.isneginf(open_list.priority[old]) & (nodes.level[old] < depth)
        tally = Tally(
            tally.num_merged + is_known,
            tally.num_reopened + (is_superseded & is_expanded),
            tally.num_overflowed + (is_new & slot.is_taken),
        )
        merit = jnp.where(is_kept, nodes.leaf[child], -jnp.inf)
        nearest = nearest.better(nodes, child, merit)
        # All is read before anything is written, or the arrays would be copied.
        slot, is_kept, is_superseded, tally, nearest = jax.lax.optimization_barrier(
            (slot, is_kept, is_superseded, tally, nearest)
        )
        open_list = OpenList(
            open_list.priority,
            table.put(slot.index, child, is_kept),
            nearest,
            tally,
        )
        open_list = open_list.close(old, is_superseded)
        is_open = is_kept & (nodes.level[child] < depth)
        return open_list.put(child, nodes.score(child), is_open), None

    return jax.lax.scan(one, open_list, (children, is_new))[0]


def actions_to(
    nodes: Nodes, node: IntScalar, max_plan_length: int
) -> Int[Array, " level"]:
    """Indices of the actions on the path to a node.

    Args:
        nodes: all.
        node: where the path ends.
        max_plan_length: of the result; a longer path is cut off, a shorter one filled
            up with its last action, an empty one with 0.

    Returns:
        The indices.
    """

    def back(carry):
        node, indices = carry
        place = nodes.level[node] - 1
        indices = indices.at[place].set(nodes.action[node], mode="drop")
        return nodes.parent[node], indices

    indices = jnp.zeros(max_plan_length, jnp.int32)
    _, indices = jax.lax.while_loop(
        lambda carry: nodes.level[carry[0]] > 0, back, (node, indices)
    )
    last = jnp.clip(nodes.level[node], 1, max_plan_length) - 1
    return indices[jnp.minimum(jnp.arange(max_plan_length), last)]
