"""Functions in lanes: any batch gives what one by one gives, derivatives too."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.lanes import in_lanes


def _mix(power, tree, weights, flags):
    """Along bodies, never along lanes."""
    x, y = tree
    total = jnp.sum(weights * x**power, axis=0)
    return {
        "total": jnp.where(flags, jnp.sin(total), total),
        "moved": x * total[None] + y[:, 0],
        "count": jnp.sum(x > 0, axis=0),
    }


def _arguments(num, seed=0):
    rng = np.random.default_rng(seed)
    x = jnp.asarray(rng.normal(size=(num, 3)))
    y = jnp.asarray(rng.normal(size=(num, 3, 2)))
    weights = jnp.asarray(rng.normal(size=(num, 3)))
    return (x, y), weights, jnp.asarray(rng.random(num) > 0.5)


def _call(tree, weights, flag, block=128):
    return in_lanes(_mix, tree, weights, flag, static=(2,), block=block)


def _plain(tree, weights, flag):
    grown = jax.tree.map(lambda leaf: leaf[..., None], (tree, weights, flag))
    return jax.tree.map(lambda leaf: leaf[..., 0], _mix(2, *grown))


@pytest.mark.parametrize("block", [256, 3])
def test_batch_is_what_each_lane_gives(block):
    call = functools.partial(_call, block=block)
    tree, weights, flags = _arguments(7)
    found = jax.jit(jax.vmap(call))(tree, weights, flags)
    expected = jax.vmap(_plain)(tree, weights, flags)
    assert jax.tree.all(jax.tree.map(np.allclose, found, expected))
    nested = jax.vmap(jax.vmap(call, (0, None, 0)), (None, 0, None))
    deep = nested(tree, weights, flags)
    wanted = jax.vmap(jax.vmap(_plain, (0, None, 0)), (None, 0, None))(
        tree, weights, flags
    )
    assert jax.tree.all(jax.tree.map(np.allclose, deep, wanted))
    assert deep["moved"].shape == (7, 7, 3)


@pytest.mark.slow
def test_derivatives_in_both_modes_are_those_of_the_function():
    tree, weights, flags = _arguments(5, seed=1)

    def loss(function):
        def of_one(tree, weights, flag):
            out = function(tree, weights, flag)
            return out["total"] + jnp.sum(out["moved"] ** 2)

        return jax.vmap(jax.grad(of_one, argnums=(0, 1)))

    found = loss(_call)(tree, weights, flags)
    expected = loss(_plain)(tree, weights, flags)
    assert jax.tree.all(jax.tree.map(np.allclose, found, expected))

    def along(function, x):
        return function((x, tree[1][0]), weights[0], flags[0])["moved"]

    for mode in (jax.jacfwd, jax.jacrev):
        found = mode(lambda x: along(_call, x))(tree[0][0])
        expected = mode(lambda x: along(_plain, x))(tree[0][0])
        assert np.allclose(found, expected)
    second = jax.hessian(lambda x: jnp.sum(along(_call, x) ** 2))(tree[0][0])
    wanted = jax.hessian(lambda x: jnp.sum(along(_plain, x) ** 2))(tree[0][0])
    assert np.allclose(second, wanted)


def test_it_works_eagerly_and_in_a_loop():
    tree, weights, flags = _arguments(1)
    first = jax.tree.map(lambda leaf: leaf[0], (tree, weights, flags))
    with jax.disable_jit():
        found = _call(*first)
    assert np.allclose(found["moved"], _plain(*first)["moved"])

    def advance(x, _):
        return _call((x, first[0][1]), *first[1:])["moved"], None

    moved, _ = jax.lax.scan(advance, first[0][0], None, length=2)
    twice = _plain((found["moved"], first[0][1]), *first[1:])["moved"]
    assert np.allclose(moved, twice)
