"""What is left of an impact that would add energy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics.contact_energy import without_gain
from boomdp_jax.physics.contact_rows import Ease

NUM_BODIES, NUM_WORLDS = 4, 300


@pytest.fixture
def impacts():
    """Twists before and after impulses between bodies, one body being static."""
    rng = np.random.default_rng(0)
    mass = 10.0 ** rng.uniform(-1, 2, (3, NUM_BODIES, NUM_WORLDS))
    mass[1] = mass[0]
    light = 1.0 / mass
    light[:, -1] = 0.0
    began = rng.normal(size=(3, NUM_BODIES, NUM_WORLDS)) * (light > 0)
    free = began + 0.1 * rng.normal(size=began.shape) * (light > 0)
    push = rng.normal(size=began.shape) * rng.uniform(0, 2, NUM_WORLDS)
    # What acts between bodies sums up to nothing.
    push[:, :-1] -= push[:, :-1].mean(axis=1, keepdims=True)
    after = free + light * push
    return mass * (light > 0), Ease(*light), began, free, after


def energy(mass, twist):
    return 0.5 * np.sum(mass * np.asarray(twist) ** 2, axis=(0, 1))


def test_no_impact_adds_energy_and_none_changes_momentum(impacts):
    mass, ease, began, free, after = impacts
    arguments = (tuple(map(jnp.asarray, twist)) for twist in (began, free, after))
    found = np.stack(without_gain(Ease(*map(jnp.asarray, ease[:3])), *arguments))
    most = np.maximum(energy(mass, began), energy(mass, free))
    gains = energy(mass, after) > (1 + 1e-4) * most
    assert 50 < np.sum(gains) < NUM_WORLDS - 50
    # Of those exactly as much is left as there was, or nothing where every share adds.
    some = gains & (np.abs(found - free).max((0, 1)) > 1e-9)
    assert np.sum(some) > 20
    np.testing.assert_allclose(energy(mass, found)[some], most[some], rtol=1e-9)
    assert np.all(energy(mass, found)[gains] <= most[gains] * (1 + 1e-9))
    np.testing.assert_array_equal(found[..., ~gains], after[..., ~gains])
    momentum = np.sum(mass * found, axis=1), np.sum(mass * free, axis=1)
    np.testing.assert_allclose(*momentum, atol=1e-9)


@pytest.mark.slow
def test_derivatives_are_finite_and_those_of_differences(impacts):
    mass, ease, began, free, after = impacts
    most = np.maximum(energy(mass, began), energy(mass, free))
    ratio = energy(mass, after) / most
    # Away from the kink at which the bound begins to act.
    is_clear = np.abs(ratio - 1.0) > 1e-2
    ease, began, free, after = jax.tree.map(
        lambda leaf: jnp.asarray(leaf)[..., is_clear], (ease, began, free, after)
    )
    along = jnp.asarray(np.random.default_rng(1).normal(size=after.shape))

    def total(size):
        moved = after + size * along
        out = without_gain(ease, tuple(began), tuple(free), tuple(moved))
        return jnp.sum(jnp.stack(out) ** 2 * (1 + jnp.arange(3.0))[:, None, None])

    slope = (total(1e-6) - total(-1e-6)) / 2e-6
    np.testing.assert_allclose(jax.grad(total)(0.0), slope, rtol=1e-6)
    np.testing.assert_allclose(jax.jvp(total, (0.0,), (1.0,))[1], slope, rtol=1e-6)


def test_a_world_at_rest_has_finite_derivatives():
    zero = tuple(jnp.zeros((2, 1)) for _ in range(3))
    ease = Ease(*(jnp.ones((2, 1)) for _ in range(3)))

    def total(after):
        return sum(jnp.sum(v) for v in without_gain(ease, zero, zero, after))

    for leaf in jax.grad(total)(zero):
        assert np.all(np.isfinite(leaf))
