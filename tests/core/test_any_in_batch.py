"""A truth value of a whole batch, and loops that end for all of it at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.any_in_batch import any_in_batch


def halvings(number, least):
    """Halve until `least` or less is left, and count turns of the loop."""

    def goes_on(carry):
        return carry[1]

    def go_on(carry):
        number, _, turns = carry
        number = jnp.where(number > least, 0.5 * number, number)
        return number, any_in_batch(number > least), turns + 1

    start = number, any_in_batch(number > least), jnp.zeros((), int)
    number, _, turns = jax.lax.while_loop(goes_on, go_on, start)
    return number, turns


@pytest.mark.parametrize("shape", [(), (5,), (2, 3, 4)])
def test_is_true_of_all_axes_together(shape):
    for value in (np.zeros(shape, bool), np.ones(shape, bool), np.arange(24) == 7):
        value = np.resize(value, shape)
        found = any_in_batch(jnp.asarray(value))
        assert found.shape == ()
        assert bool(found) == bool(value.any())


@pytest.mark.parametrize("axis", [0, 1])
def test_is_one_for_a_whole_batch(axis):
    value = np.zeros((3, 4), bool)
    value[2, 1] = True
    # Mapped over both axes in either order, nothing is left to be mapped over.
    outer = jax.vmap(any_in_batch, in_axes=0, out_axes=None)
    found = jax.jit(jax.vmap(outer, in_axes=axis, out_axes=None))(value)
    assert found.shape == ()
    assert bool(found)


def test_a_batched_loop_ends_when_the_last_one_is_done():
    number = jnp.asarray([[1.0, 8.0, 0.5], [3.0, 64.0, 1.0]])
    batched = jax.vmap(jax.vmap(halvings, (0, None)), (0, None))
    left, turns = jax.jit(batched)(number, 1.0)
    np.testing.assert_array_equal(left, [[1.0, 1.0, 0.5], [0.75, 1.0, 1.0]])
    assert np.all(turns == 6)
    alone, turns = halvings(number[0, 1], 1.0)
    assert alone == 1.0
    assert turns == 3


def test_carries_of_a_batched_loop_are_not_selected_anew():
    def count(condition):
        def loop(number):
            return jax.lax.while_loop(condition, lambda x: 0.5 * x, number)

        lowered = jax.jit(jax.vmap(loop)).lower(jnp.ones(4))
        return lowered.as_text().count("select")

    assert count(lambda x: x > 1.0) == 1
    assert count(lambda x: any_in_batch(x > 1.0)) == 0


def test_a_loop_can_be_within_what_is_differentiated():
    def value(x, number):
        left, _ = halvings(jax.lax.stop_gradient(number), 1.0)
        return x * x * left

    number, x = jnp.asarray([8.0, 3.0]), jnp.asarray([2.0, 5.0])
    for slope in (jax.grad, jax.jacfwd):
        found = jax.jit(jax.vmap(slope(value)))(x, number)
        np.testing.assert_allclose(found, [4.0, 7.5])
