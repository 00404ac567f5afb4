"""Functions of small arrays in one loop: what they yield as arrays, in every mode."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.one_loop import one_loop
from boomdp_jax.core.written_out import one_loop_of_arrays

NUM = 11


def moved_about(scale, feet, pin):
    """Slices, stacks, repeats, reductions and truth values, on axes of every length."""
    place, load, is_on = feet["place"], feet["load"], feet["is_on"]
    arm = jnp.stack([place[:, 1], -place[:, 0]], axis=1)
    turned = jnp.concatenate([arm, place[::-1]]).T
    c = jnp.where(is_on, load, 0.0)
    heavy = jnp.tile(c[None], (2, 1)) * jnp.repeat(turned, 2, axis=1)[:, ::4]
    first, rest = jnp.split(heavy, [1], axis=1)
    norm = jnp.sqrt(1.0 + jnp.sum(place**2, axis=-1))
    return {
        "total": scale * jnp.sum(c * norm) * pin,
        "ends": (jnp.min(turned), jnp.max(turned, axis=0)),
        "parts": [first.reshape(-1), rest.swapaxes(0, 1), jnp.flip(norm)],
        "above": norm > 1.5,
        "some": jnp.any(is_on) & ~jnp.all(place > 0.0),
        "constant": jnp.arange(3.0, dtype=pin.dtype) + pin[None],
        "none": jnp.min(jnp.zeros((0, 2), pin.dtype) * pin, axis=1),
        "sum of none": jnp.sum(jnp.zeros((2, 0), pin.dtype) + pin, axis=1),
    }


@pytest.fixture
def numbers(precision):
    dtype = precision.choose(single=jnp.float32, double=jnp.float64)
    keys = jax.random.split(jax.random.key(0), 4)
    feet = {
        "place": jax.random.normal(keys[0], (NUM, 3, 2), dtype),
        "load": jax.random.normal(keys[1], (NUM, 3), dtype),
        "is_on": jax.random.bernoulli(keys[2], 0.6, (NUM, 3)),
    }
    return feet, jax.random.normal(keys[3], (NUM,), dtype)


@pytest.fixture
def close(precision):
    def check(one, other):
        tolerance = precision.choose(single=3e-6, double=1e-14)
        assert jax.tree.structure(one) == jax.tree.structure(other)
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
            assert (a.dtype, a.shape) == (b.dtype, b.shape)
            np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)

    return check


def looped(feet, pin):
    return one_loop_of_arrays(moved_about, feet, pin, static=(2.0,))


def plain(feet, pin):
    return moved_about(2.0, feet, pin)


def test_yields_what_the_arrays_do(numbers, close):
    close(jax.jit(jax.vmap(looped))(*numbers), jax.vmap(plain)(*numbers))
    alone = jax.tree.map(lambda leaf: leaf[0], numbers)
    close(looped(*alone), plain(*alone))
    shared = (numbers[0], numbers[1][0])
    close(*(jax.vmap(f, (0, None))(*shared) for f in (looped, plain)))


def total(f):
    def of_floats(place, load, is_on, pin):
        out = f({"place": place, "load": load, "is_on": is_on}, pin)
        leaves = [x for x in jax.tree.leaves(out) if x.dtype != jnp.bool_]
        return sum(jnp.sum(jnp.sin(leaf)) for leaf in leaves)

    return of_floats


@pytest.mark.slow
def test_derivatives(numbers, close):
    feet, pin = numbers
    arguments = (feet["place"], feet["load"], feet["is_on"], pin)
    for mode in (jax.grad, jax.jacfwd, lambda f, n: jax.jacfwd(jax.grad(f, n), n)):
        one, other = (jax.vmap(mode(total(f), (0, 1, 3))) for f in (looped, plain))
        close(jax.jit(one)(*arguments), other(*arguments))


def test_is_one_loop(numbers):
    """What the whole is for: the compiler sees a single operation."""
    assert jax.default_backend() == "cpu"
    text = jax.jit(jax.vmap(looped)).lower(*numbers).as_text()
    assert len(re.findall(r"stablehlo\.reduce_window", text)) == 1
    assert "stablehlo.sqrt" in text
    assert not re.search(r"stablehlo\.sqrt %\S+ : tensor<\d", text)


def sorted_array(x):
    return jnp.sort(x)


def counted(x):
    return jnp.arange(3) + (x > 0)


def test_refuses_what_it_cannot_write_out():
    x = jnp.ones(3)
    with pytest.raises(TypeError, match=r"arithmetic, reductions .* got sort"):
        one_loop_of_arrays(sorted_array, x)
    with pytest.raises(TypeError, match=r"returns arrays of type float.* got int"):
        one_loop_of_arrays(counted, x)
    with pytest.raises(TypeError, match="needs a floating array"):
        one_loop_of_arrays(sorted_array, x > 0)
    outside = []

    def leaky(x):
        return x * outside[0]

    def with_leak(y):
        outside[:] = [y]
        return one_loop_of_arrays(leaky, x)

    with pytest.raises(TypeError, match="traced value from outside"):
        jax.jit(with_leak)(jnp.ones(3))


def two_results(x, y):
    flat = jax.lax.stop_gradient(x) * 3.0
    return x * y, flat, jnp.where(x > 0, y, 2.0)


def test_results_without_a_derivative_have_none():
    """One that is known to stand still costs nothing further on."""

    def parts(x, y):
        return one_loop(two_results, x, y)

    x, y = jnp.linspace(-1.0, 1.0, NUM), jnp.linspace(1.0, 2.0, NUM)
    lone = jax.linearize(lambda x: jax.vmap(parts)(x, y)[1:], x)[1]
    for rate in lone(jnp.ones(NUM)):
        np.testing.assert_array_equal(rate, 0.0)
    text = str(jax.make_jaxpr(lambda x: jax.jvp(jax.vmap(parts), (x, y), (x, y)))(x))
    assert text.count("one_loop[") == 2
    product, _, chosen = jax.jvp(jax.vmap(parts), (x, y), (x, y))[1]
    np.testing.assert_allclose(product, 2 * x * y, rtol=1e-6)
    np.testing.assert_allclose(chosen, np.where(x > 0, y, 0.0))
