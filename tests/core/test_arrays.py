"""Arrays from numbers, and rows of trees of them."""

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.arrays import on_device, row_of


def test_numbers_on_the_device_do_not_share_memory_with_the_host():
    numbers = np.arange(3.0)
    found = on_device(numbers, float)
    numbers[0] = 9.0
    assert np.asarray(found).tolist() == [0.0, 1.0, 2.0]


def test_a_row_of_a_tree_is_that_of_each_of_its_arrays():
    keys = jax.random.split(jax.random.key(1), 3)
    tree = {
        "numbers": jnp.arange(6.0).reshape(3, 2),
        "flags": np.array([1, 0, 1], bool),
    }
    for index in range(3):
        found = row_of({**tree, "keys": keys}, index)
        assert found["numbers"].tolist() == [2.0 * index, 2.0 * index + 1.0]
        assert bool(found["flags"]) == tree["flags"][index]
        assert found["keys"] == keys[index]
