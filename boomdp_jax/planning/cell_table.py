"""Which node is in a cell of a grid: a hash table with a bounded number of probes.

A cell may be in any of a few neighbouring slots, from the one that its hash says. Slots
hold numbers of nodes; whether a slot's node is really in the cell that is asked for is
told by that node's own cell. A cell all of whose slots are taken by others gets the
first of them; the cell that was there is forgotten.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from boomdp_jax.core.arrays import BoolScalar, IntScalar
from boomdp_jax.planning.grid import hash_of


class Slot(NamedTuple):
    """Where a cell is in the table, or would be."""

    index: IntScalar
    node: IntScalar
    """In the cell; −1 if none is known."""
    is_taken: BoolScalar
    """By another cell, as are all others where this cell may be."""


class CellTable(eqx.Module):
    """Slots that hold the number of a node, or −1."""

    node: Int[Array, " slot"]
    num_probes: int = eqx.field(static=True)
    """Slots that a cell may be in."""

    @property
    def size(self) -> int:
        """Number of slots."""
        return self.node.shape[0]

    def find(
        self, cells: Int[Array, "node channel"], cell: Int[Array, " channel"]
    ) -> Slot:
        """Look a cell up.

        Args:
            cells: of all nodes.
            cell: to look for.

        Returns:
            The slot that holds the cell, else the first empty one that may, else the
            first that may.
        """
        probes = jnp.arange(self.num_probes, dtype=jnp.uint32)
        slots = ((hash_of(cell[None])[0] + probes) % np.uint32(self.size)).astype(
            jnp.int32
        )
        nodes = self.node[slots]
        is_match = (nodes >= 0) & jnp.all(cells[nodes] == cell[None], axis=1)
        is_known, is_empty = jnp.any(is_match), nodes < 0
        probe = jnp.where(is_known, jnp.argmax(is_match), jnp.argmax(is_empty))
        node = jnp.where(is_known, nodes[probe], -1)
        return Slot(slots[probe], node, ~is_known & ~jnp.any(is_empty))

    def put(
        self, slot: IntScalar, node: IntScalar, is_wanted: BoolScalar
    ) -> "CellTable":
        """Let a slot hold a node, if that is wanted."""
        slot = jnp.where(is_wanted, slot, self.size)
        return CellTable(self.node.at[slot].set(node, mode="drop"), self.num_probes)


def empty_table(size: int, num_probes: int) -> CellTable:
    """A table of so many slots, all empty."""
    return CellTable(jnp.full(size, -1, jnp.int32), min(num_probes, size))
