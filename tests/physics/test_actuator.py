"""Gain, bias and delay of commands, against integrals and steps of a hundredth."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics import (
    Actuator,
    State,
    delayed_wrenches,
    rollout,
    scene_spec_from_dict,
    step,
)

SPEC = scene_spec_from_dict(
    {
        "schema": "planar-scene-1",
        "dt": 0.02,
        "bodies": [
            {
                "name": "box",
                "density": 20.0,
                "shape": {"type": "box", "half_extents": [0.3, 0.2]},
            },
            {
                "name": "wall",
                "static": True,
                "pose": [3.0, 0.0, 0.0],
                "shape": {"type": "box", "half_extents": [0.1, 2.0]},
            },
        ],
    }
)
MASS = 20.0 * 0.24


def with_actuator(**numbers):
    values = {key: jnp.asarray(value, float) for key, value in numbers.items()}
    return dataclasses.replace(SPEC.params(), actuator=Actuator(**values))


def at_rest() -> State:
    pose = jnp.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    return State(pose, jnp.zeros((2, 3)))


@pytest.mark.slow
def test_gain_and_bias_are_those_of_the_wrench():
    """Velocities by Newton, and a wall that no bias moves."""
    bias = [[1.0, -2.0, 0.1], [5.0, 5.0, 5.0]]
    params = with_actuator(gain=[0.8, 1.0], bias=bias)
    push = jnp.array([[10.0, 4.0, 0.5], [0.0, 0.0, 0.0]])
    after, _ = step(SPEC.scene, params, at_rest(), push)
    inertia = MASS * (0.3**2 + 0.2**2) / 3.0
    wrench = 0.8 * np.array([10.0, 4.0, 0.5]) + [1.0, -2.0, 0.1]
    expected = 0.02 * wrench / [MASS, MASS, inertia]
    np.testing.assert_allclose(after.twist[0], expected, rtol=1e-12)
    np.testing.assert_array_equal(after.array[1], at_rest().array[1])
    wrenches = jnp.broadcast_to(push, (5, 2, 3))
    states, _ = rollout(SPEC.scene, params, at_rest(), wrenches)
    np.testing.assert_allclose(states.twist[-1, 0], 5.0 * expected, rtol=1e-12)


def in_effect(commands, dt, is_start, delay, num=20_000):
    """Mean over each step of what was commanded so long ago, by a fine sum."""
    begin = np.concatenate([[0.0], np.cumsum(dt)])
    out = np.zeros_like(commands)
    for row in range(len(dt)):
        first = np.flatnonzero(is_start[: row + 1])[-1]
        times = begin[row] + dt[row] * (np.arange(num) + 0.5) / num - delay
        source = np.searchsorted(begin, times, side="right") - 1
        known = source >= first
        values = commands[np.where(known, source, first)] * known[:, None]
        out[row] = values.mean(axis=0)
    return out


@pytest.mark.parametrize("delay", [0.0, 0.007, 0.02, 0.033, 0.11])
def test_a_delayed_command_is_its_mean_over_the_step(delay):
    """Steps of unequal length, and two runs of which none knows of the other."""
    rng = np.random.default_rng(0)
    commands = rng.normal(size=(12, 2, 3))
    dt = rng.uniform(0.01, 0.03, size=12)
    is_start = np.isin(np.arange(12), [0, 7])
    params = with_actuator(delay=[delay, 0.0])
    found = np.asarray(delayed_wrenches(params, commands, dt, is_start=is_start))
    expected = in_effect(commands[:, 0], dt, is_start, delay)
    np.testing.assert_allclose(found[:, 0], expected, atol=2e-3)
    np.testing.assert_allclose(found[:, 1], commands[:, 1], atol=1e-12)


def test_without_a_delay_commands_are_what_they_are():
    commands = np.random.default_rng(1).normal(size=(4, 2, 3))
    for params in (SPEC.params(), with_actuator(gain=[2.0, 1.0])):
        np.testing.assert_array_equal(
            delayed_wrenches(params, commands, 0.02), commands
        )


def test_commands_of_a_run_never_take_effect_before_it_begins():
    commands = np.ones((40, 2, 3))
    params = with_actuator(delay=[0.3, 0.45])
    found = np.asarray(delayed_wrenches(params, commands, 0.02))
    np.testing.assert_allclose(found[:15, 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(found[15:, 0], 1.0)
    np.testing.assert_allclose(found[22, 1], 0.5)


@pytest.mark.slow
def test_velocities_are_those_of_commands_that_switch_within_a_step():
    """Steps of a hundredth, in which the command of the time is held."""
    rng = np.random.default_rng(2)
    commands, fine, delay = np.zeros((10, 2, 3)), 100, 0.0134
    commands[:, 0] = rng.normal(size=(10, 3)) * [20.0, 20.0, 2.0]
    times = (np.arange(10 * fine) + 0.5) * 0.02 / fine - delay
    source = np.floor(times / 0.02).astype(int)
    held = np.where((source >= 0)[:, None, None], commands[np.maximum(source, 0)], 0.0)
    exact, _ = rollout(
        SPEC.scene, SPEC.params(), at_rest(), jnp.asarray(held), dt=0.02 / fine
    )
    params = with_actuator(delay=[delay, 0.0])
    wrenches = delayed_wrenches(params, commands, 0.02)
    ours, _ = rollout(SPEC.scene, params, at_rest(), wrenches)
    there = jax.tree.map(lambda leaf: leaf[fine - 1 :: fine], exact)
    np.testing.assert_allclose(ours.twist, there.twist, atol=1e-9)
    # A change of force within a step moves no more than |Δf| Δt² / 8m, each step.
    jump = np.abs(np.diff(commands[:, 0, :2], axis=0, prepend=0.0)).max()
    most = 10 * jump * 0.02**2 / (8.0 * MASS)
    np.testing.assert_allclose(ours.pose[:, :, :2], there.pose[:, :, :2], atol=most)
    early = rollout(SPEC.scene, SPEC.params(), at_rest(), jnp.asarray(commands))[0]
    assert np.abs(early.twist - there.twist).max() > 1e-2


@pytest.mark.slow
def test_derivatives_by_the_delay_are_those_of_differences():
    commands = np.random.default_rng(3).normal(size=(6, 2, 3))

    def end(delay):
        params = with_actuator(gain=[1.0, 1.0])
        params = dataclasses.replace(params, actuator=Actuator(delay=delay))
        return delayed_wrenches(params, commands, 0.02)[:, 0]

    delay = jnp.array([0.027, 0.0])
    ours = jax.jacfwd(end)(delay)[..., 0]
    shift = jnp.array([1e-6, 0.0])
    theirs = (end(delay + shift) - end(delay - shift)) / 2e-6
    np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-6)
    # At the edges, where a command's share is zero or one, as well.
    for edge in (0.0, 0.02, 0.04):
        assert np.all(np.isfinite(jax.jacrev(end)(jnp.array([edge, 0.0]))))
