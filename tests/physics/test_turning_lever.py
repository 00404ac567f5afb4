"""A lone body on a pin that turns fast under a push, against an adaptive integrator."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from boomdp_jax.physics import rollout, step
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict
from boomdp_jax.physics.state import State

DT, NUM = 0.05, 200
HALF, DENSITY, ANCHOR = np.array([0.3, 0.2]), 12.5, np.array([0.2, 0.1])
MASS = DENSITY * 4.0 * HALF.prod()
ABOUT_PIN = MASS * (np.sum(HALF**2) / 3.0 + ANCHOR @ ANCHOR)


def pinned(viscous: float) -> SceneSpec:
    pin = {"type": "revolute", "a": "box", "b": "world", "anchor_b": [0.0, 0.0]}
    pin |= {"anchor_a": ANCHOR.tolist(), "viscous": viscous}
    shape = {"type": "box", "half_extents": HALF.tolist()}
    body = {"name": "box", "shape": shape, "density": DENSITY}
    content = {"schema": "planar-scene-1", "gravity": [0.0, 0.0], "dt": DT}
    return scene_spec_from_dict(content | {"bodies": [body], "constraints": [pin]})


def arm(heading):
    """From the pin to the centre of mass, world frame [m]."""
    cos, sin = np.cos(heading), np.sin(heading)
    return -np.stack([cos * ANCHOR[0] - sin * ANCHOR[1],
                      sin * ANCHOR[0] + cos * ANCHOR[1]], axis=-1)  # fmt: skip


def exact(heading, spin, wrench, viscous) -> tuple[float, float]:
    """Heading and spin after a step."""

    def rate(_, now):
        x, y = arm(now[0])
        torque = wrench[2] + x * wrench[1] - y * wrench[0] - viscous * now[1]
        return [now[1], torque / ABOUT_PIN]

    found = solve_ivp(rate, (0.0, DT), [heading, spin], rtol=1e-10, atol=1e-12)
    return found.y[0, -1], found.y[1, -1]


@pytest.mark.parametrize("viscous", [0.0, 0.2])
def test_a_push_changes_the_spin_by_what_its_turning_lever_makes_of_it(viscous):
    rng = np.random.default_rng(0)
    heading, spin = rng.uniform(-np.pi, np.pi, NUM), rng.uniform(-14.0, 14.0, NUM)
    wrench = rng.uniform(-1.0, 1.0, (NUM, 3)) * [40.0, 40.0, 4.0]
    place = arm(heading)
    velocity = spin[:, None] * np.stack([-place[:, 1], place[:, 0]], axis=1)
    pose = np.column_stack([place, heading])[:, None]
    twist = np.column_stack([velocity, spin])[:, None]
    spec = pinned(viscous)
    scene, params = spec.scene, spec.params()

    def advance(pose, twist, push):
        return step(scene, params, State(pose, twist), push)[0].array[0]

    parts = map(jnp.asarray, (pose, twist, wrench[:, None]))
    after = np.asarray(jax.jit(jax.vmap(advance))(*parts))
    truth = np.array([
        exact(*start, viscous) for start in zip(heading, spin, wrench, strict=True)
    ])  # fmt: skip
    # Up to 0.35 rad a part of the step, of which there are two.
    gained, error = truth[:, 1] - spin, after[:, 5] - truth[:, 1]
    # A share of what is gained that is missing is a mass that is too large.
    assert abs(error @ gained) < 5e-4 * (gained @ gained)
    assert np.sqrt(np.mean(error**2)) < 3e-3
    np.testing.assert_allclose(after[:, 2], truth[:, 0], atol=2e-3)


@pytest.mark.parametrize("dt", [0.05, 0.1])
@pytest.mark.parametrize("swing", [1.0, 2.5, 3.0])
def test_swings_without_friction_neither_grow_nor_shrink_in_ten_minutes(dt, swing):
    """A bar hung at its end, which turns by up to 0.76 rad in a step."""
    pin = {"type": "revolute", "a": "bar", "b": "world", "anchor_b": [0.0, 0.0]}
    pin["anchor_a"] = [0.0, 0.5]
    shape = {"type": "box", "half_extents": [0.05, 0.5]}
    body = {"name": "bar", "shape": shape, "density": 20.0}
    content = {"schema": "planar-scene-1", "gravity": [0.0, -9.8], "dt": dt}
    spec = scene_spec_from_dict(content | {"bodies": [body], "constraints": [pin]})
    start = [0.5 * np.sin(swing), -0.5 * np.cos(swing), swing]
    begin = State(jnp.asarray([start]), jnp.zeros((1, 3)))
    still = jnp.zeros((round(600.0 / dt), 1, 3))
    states, _ = jax.jit(lambda: rollout(spec.scene, spec.params(), begin, still))()
    pose, twist = np.asarray(states.pose[:, 0]), np.asarray(states.twist[:, 0])
    gyration = (0.05**2 + 0.5**2) / 3.0
    speed = np.sum(twist[:, :2] ** 2, axis=1) + gyration * twist[:, 2] ** 2
    energy = 0.5 * speed + 9.8 * (pose[:, 1] + 0.5)
    share = energy / (9.8 * 0.5 * (1.0 - np.cos(swing)))
    assert np.abs(share - 1.0).max() < 0.01
    # Nor is there a drift that goes on: of the last minute the mean is that of the
    # first one.
    minute = round(60.0 / dt)
    assert abs(share[-minute:].mean() - share[:minute].mean()) < 2e-3
