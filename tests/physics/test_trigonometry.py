"""Sines and cosines of the engine against NumPy's in double precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics.trigonometry import heading_turn, rotated, sincos

LARGEST = 1e4


def angles(limit: float, dtype) -> np.ndarray:
    """Angles all over a range, with its special places."""
    special = np.arange(-8, 9) * np.pi / 4
    spread = np.random.default_rng(0).uniform(-limit, limit, 100_000)
    return np.concatenate([special[np.abs(special) <= limit], spread]).astype(dtype)


@pytest.mark.parametrize("limit", [1.0, 10.0, LARGEST])
def test_single_precision_is_right_to_rounding(limit):
    angle = jnp.asarray(angles(limit, np.float32))
    exact = np.asarray(angle, float)
    sin, cos = jax.jit(sincos)(angle)
    np.testing.assert_allclose(sin, np.sin(exact), atol=1.2e-7)
    np.testing.assert_allclose(cos, np.cos(exact), atol=1.2e-7)
    cos, sin = jax.jit(heading_turn)(angle)
    np.testing.assert_allclose(sin, np.sin(exact), atol=3e-7)
    np.testing.assert_allclose(cos, np.cos(exact), atol=3e-7)


def test_double_precision_is_the_library_s():
    angle = angles(LARGEST, np.float64)
    cos, sin = heading_turn(jnp.asarray(angle))
    assert cos.dtype == jnp.float64
    np.testing.assert_allclose(sin, np.sin(angle), atol=1e-15)
    np.testing.assert_allclose(cos, np.cos(angle), atol=1e-15)


@pytest.mark.parametrize(("limit", "error"), [(0.5, 1e-13), (2.0, 2e-7), (np.pi, 3e-5)])
def test_turning_further_adds_angles(limit, error):
    start = jnp.asarray(angles(10.0, np.float64))
    angle = jnp.resize(jnp.asarray(angles(limit, np.float64)), start.shape)
    cos, sin = rotated((jnp.cos(start), jnp.sin(start)), angle)
    np.testing.assert_allclose(cos, np.cos(start + angle), atol=error)
    np.testing.assert_allclose(sin, np.sin(start + angle), atol=error)
    np.testing.assert_allclose(np.hypot(cos, sin), 1.0, atol=1e-14)


def test_derivatives_of_a_small_turn():
    for angle in (-1.0, 0.0, 0.3):
        rates = jax.jacfwd(lambda a: jnp.stack(rotated(None, a)))(angle)
        np.testing.assert_allclose(rates, [-np.sin(angle), np.cos(angle)], atol=1e-8)
