"""The table that tells cells apart: nothing is lost, nothing is mistaken."""

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.planning.cell_table import empty_table


def test_a_full_table_still_tells_all_its_cells_apart():
    generator = np.random.default_rng(2)
    cells = generator.permutation(64)[:, None] * np.array([[1, -7, 1000]])
    cells = jnp.asarray(cells.astype(np.int32))

    def put(table, node):
        slot = table.find(cells, cells[node])
        return table.put(slot.index, node, jnp.array(True)), slot.node

    @jax.jit
    def fill_and_find():
        nodes = jnp.arange(64, dtype=jnp.int32)
        table, before = jax.lax.scan(put, empty_table(64, 64), nodes)
        unknown = table.find(cells, jnp.array([1, 1, 1], jnp.int32))
        after = jax.vmap(lambda cell: table.find(cells, cell))(cells)
        return before, after, unknown

    before, after, unknown = fill_and_find()
    np.testing.assert_array_equal(before, -1)
    np.testing.assert_array_equal(after.node, np.arange(64))
    assert unknown.node == -1
    assert unknown.is_taken
    assert not np.any(after.is_taken)
