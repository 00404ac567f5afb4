"""Long functions of scalars: cut anywhere, they yield what they yield whole."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.one_loop import one_loop
from boomdp_jax.core.scalar_parts import parts_of


def tangle(x, y, z):
    """Truth values, integers, called functions, numbers and arguments as results."""
    flags = [x > y, y > z]
    count = jnp.round(3.0 * x).astype(jnp.int32) & 3
    for i in range(4):
        x, y = jnp.where(flags[0], x + y * z, x - 0.5), jnp.clip(x * y, -1.0, 1.0) + i
        x = jnp.where(flags[1] & (count > 1), jnp.sqrt(1.0 + x * x), x)
        flags.append(x > y)
    unused = jnp.exp(x)
    del unused
    return [x, y, z, jnp.where(flags[-1], z, 2.0), jnp.asarray(1.5, x.dtype)]


def run(parts, values):
    """Parts one after the other."""
    values, out = list(values), []
    for part in parts:
        out = part.function(*(values[i] for i in part.inputs))
        assert len(out) == part.num_outputs
        values += out
    return out


@pytest.mark.parametrize("most", [1, 2, 3, 5, 8, 13, 1000])
def test_parts_yield_what_the_whole_does(most, precision):
    dtype = precision.choose(single=jnp.float32, double=jnp.float64)
    values = jax.random.normal(jax.random.key(most), (3, 50), dtype)
    jaxpr = jax.make_jaxpr(tangle)(*(jax.ShapeDtypeStruct((), dtype),) * 3)
    parts = parts_of(jaxpr, most, most)
    found = jax.jit(jax.vmap(lambda *v: run(parts, v)))(*values)
    expected = jax.jit(jax.vmap(tangle))(*values)
    tolerance = precision.choose(single=1e-6, double=1e-14)
    for one, other in zip(found, expected, strict=True):
        assert one.dtype == dtype
        np.testing.assert_allclose(one, other, rtol=tolerance)
    assert len(parts) == 1 if most == 1000 else len(parts) >= 40 / most


def constant(x):
    del x
    return jnp.asarray(2.0, jnp.float32)


def test_a_result_without_arguments():
    (part,) = parts_of(jax.make_jaxpr(constant)(jax.ShapeDtypeStruct((), jnp.float32)))
    assert part.function(jnp.float32(7.0)) == [2.0]
    np.testing.assert_array_equal(
        jax.vmap(lambda x: one_loop(constant, x))(jnp.ones(3, jnp.float32)), [2.0] * 3
    )


def turned(angles, x, y):
    """Turned through many angles, one after the other."""
    for angle in angles:
        cos, sin = np.float32(np.cos(angle)), np.float32(np.sin(angle))
        x, y = cos * x - sin * y, sin * x + cos * y
    return x, y


@pytest.mark.slow
def test_a_function_that_no_compiler_takes_whole():
    angles = tuple(0.1 + 1e-3 * i for i in range(1500))
    x, y = jax.random.normal(jax.random.key(0), (2, 16), jnp.float32)
    expected = np.asarray(x + 1j * y) * np.exp(1j * sum(angles))
    program = jax.jit(jax.vmap(lambda x, y: one_loop(turned, x, y, static=(angles,))))
    lowered = program.lower(x, y)
    # Six operations an angle, of which a compiler takes 2000 whole.
    assert lowered.as_text().count("stablehlo.reduce_window") >= 6 * 1500 / 2000
    found = lowered.compile()(x, y)
    difference = np.asarray(found[0] + 1j * found[1]) - expected
    assert np.max(np.abs(difference)) < 1e-3
