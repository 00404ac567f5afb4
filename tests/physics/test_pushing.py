"""A finger pushes a body that stands on stiff, dry feet: quasi-static sliding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics import rollout
from tests.physics.contact_scenes import body, spec_of
from tests.reference import limit_surface

pytestmark = pytest.mark.slow

FEET = np.array([[-0.04, -0.04], [-0.04, 0.08], [0.08, -0.04]])
CORNERS = [[-0.05, -0.05], [0.1, -0.05], [-0.05, 0.1]]
AREA, MASS, FRICTION, G = 0.15**2 / 2, 1.5, 0.3, 9.81
LIMIT = np.full(3, FRICTION * MASS * G / 3.0)
DT, TIP, FINGER = 0.04, 1e-3, 1e8


def _push(height, speed, num_steps, *, gap=2e-4, viscous=1e5, rubbing=2.0):
    """Push a block to the right on its left face; poses `[row, 2, 3]` and forces [N].

    The finger is so heavy that it goes its way, and what it loses of momentum is the
    force.
    """
    block = body("block", CORNERS, (0, 0, 0), friction=rubbing, density=MASS / AREA)
    block["feet"] = FEET.tolist()
    spec = spec_of(
        block,
        body(
            "finger",
            TIP,
            (-0.05 - TIP - gap, height, 0.0),
            (speed, 0.0, 0.0),
            friction=rubbing,
            density=FINGER / (np.pi * TIP**2),
        ),
        gravity=(0.0, 0.0),
        dt=DT,
        constraints=[
            {"type": "ground", "a": "block", "dry": FRICTION, "viscous": viscous}
        ],
    )
    start = spec.initial_state()
    states, info = jax.jit(rollout)(
        spec.scene, spec.params(), start, jnp.zeros((num_steps, 2, 3))
    )
    speeds = np.append([[speed, 0.0]], np.asarray(states.twist)[:, 1, :2], axis=0)
    force = -FINGER * np.diff(speeds, axis=0) / DT
    return np.asarray(states.pose), force, info


def test_pushing_through_the_centre_takes_the_dry_limit():
    # No moment about the centre of pressure, which is the origin here.
    pose, force, info = _push(0.0, 3e-3, 150)
    steady = force[60:, 0]
    np.testing.assert_allclose(np.median(steady), LIMIT.sum(), rtol=1e-3)
    np.testing.assert_allclose(steady, LIMIT.sum(), rtol=0.02)
    # It does not jump ahead of the finger, nor is it run through.
    gap = pose[:, 0, 0] - 0.05 - (pose[:, 1, 0] + TIP)
    assert np.max(gap[20:]) < 2e-5
    assert np.max(np.asarray(info.overlap)) < 2e-4
    assert np.max(np.abs(pose[:, 0, 2])) < 1e-4


@pytest.mark.parametrize("height", [0.06, -0.03])
def test_off_centre_it_turns_as_the_feet_have_it(height):
    num_steps, speed = 200, 3e-3
    pose, force, _ = _push(height, speed, num_steps)
    heading = pose[:, 0, 2]
    first = int(np.argmax(np.abs(heading) > 1e-5))
    times = DT * np.arange(num_steps - first)
    # Friction between them is high: the finger holds the point that it touches.
    expected = limit_surface.towed_heading(
        FEET, LIMIT, (-0.05, height), (speed, 0.0), heading[first], times
    )
    assert abs(expected[-1]) > 0.1
    np.testing.assert_allclose(heading[first:], expected, atol=0.02 * abs(expected[-1]))
    # What the finger gives is what the feet take.
    local = limit_surface.foot_wrench(
        FEET, LIMIT, _twist_of(pose[-2:, 0], pose[-1, 0, 2])
    )
    turn = pose[-1, 0, 2]
    frame = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    np.testing.assert_allclose(
        force[-25:].mean(axis=0), -frame @ local[:2], atol=0.05 * LIMIT.sum()
    )


def _twist_of(poses, heading):
    """Of two poses, in the body's frame."""
    velocity, spin = np.diff(poses[:, :2], axis=0)[0] / DT, np.diff(poses[:, 2])[0] / DT
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array(
        [
            cos * velocity[0] + sin * velocity[1],
            cos * velocity[1] - sin * velocity[0],
            spin,
        ]
    )


@pytest.mark.parametrize("speed", [1e-3, 0.02, 0.3])
@pytest.mark.parametrize("viscous", [200.0, 1e5])
def test_a_first_touch_does_not_throw_it_ahead(speed, viscous):
    first = 3
    pose, _, info = _push(
        0.0, speed, 40, gap=(first + 0.5) * speed * DT, viscous=viscous
    )
    gap = pose[:, 0, 0] - 0.05 - (pose[:, 1, 0] + TIP)
    assert gap[first - 1] > 0.0
    assert np.max(gap[first + 1 :]) < 0.05 * speed * DT + 1e-5
    assert np.max(np.asarray(info.overlap)) < 0.3 * speed * DT + 2e-4
