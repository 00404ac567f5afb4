"""A force at a point is a wrench at the reference point, by hand and by the engine."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core import make_history, wrench_at_reference
from boomdp_jax.physics import State, scene_spec_from_dict, step


def test_a_force_turns_by_its_arm():
    """Arm (0.5, 2) × force (2, 3) = 1.5 - 4."""
    wrench = wrench_at_reference(
        np.array([2.0, 3.0, 0.5]), np.array([1.5, 3.0]), np.array([1.0, 1.0, 0.7])
    )
    assert isinstance(wrench, np.ndarray)
    np.testing.assert_allclose(wrench, [2.0, 3.0, 0.5 + 1.5 - 4.0])


def test_a_point_of_the_body_turns_with_it():
    """At a quarter turn, (0.5, 2) of the body is (-2, 0.5) of the world."""
    wrench = wrench_at_reference(
        jnp.array([2.0, 3.0, 0.5]),
        jnp.array([0.5, 2.0]),
        jnp.array([1.0, 1.0, jnp.pi / 2]),
        frame="body",
    )
    assert isinstance(wrench, jax.Array)
    np.testing.assert_allclose(wrench, [2.0, 3.0, 0.5 - 2.0 * 3.0 - 0.5 * 2.0])


def test_both_frames_agree_for_many():
    rng = np.random.default_rng(0)
    wrench, pose = rng.normal(size=(2, 4, 5, 3))
    local = rng.normal(size=(4, 5, 2))
    turn = np.exp(1j * pose[..., 2]) * (local[..., 0] + 1j * local[..., 1])
    world = pose[..., :2] + np.stack([turn.real, turn.imag], axis=-1)
    np.testing.assert_allclose(
        wrench_at_reference(wrench, local, pose, frame="body"),
        wrench_at_reference(wrench, world, pose),
        atol=1e-12,
    )


@pytest.mark.parametrize("frame", ["world", "body"])
def test_no_point_is_the_reference_point_and_no_force_needs_none(frame):
    """Derivatives stay finite, too."""
    nothing = jnp.full(2, jnp.nan)
    pose = jnp.array([1.0, 2.0, 0.3])
    for wrench in (jnp.array([2.0, 3.0, 0.5]), jnp.array([0.0, 0.0, 0.5])):
        found = wrench_at_reference(wrench, nothing, pose, frame=frame)
        np.testing.assert_array_equal(found, wrench)
        slope = jax.jacrev(
            lambda p, w=wrench: wrench_at_reference(w, nothing, p, frame=frame)
        )(pose)
        np.testing.assert_array_equal(slope, 0.0)
    pushed = jnp.array([2.0, 3.0, 0.5])
    half = wrench_at_reference(pushed, jnp.array([jnp.nan, 1.0]), pose, frame=frame)
    assert jnp.isnan(half[2])


def test_another_frame_is_refused():
    with pytest.raises(ValueError, match="frame: expected world or body, got 'tool'"):
        wrench_at_reference(np.ones(3), np.ones(2), np.ones(3), frame="tool")


def rows(num):
    return np.zeros((num, 1, 6)), np.ones((num, 1, 3)), np.zeros((num, 1, 6))


def test_a_history_takes_points_of_the_body():
    state, action, next_state = rows(2)
    state[:, 0, :3] = [1.0, 1.0, np.pi / 2]
    action[:] = [2.0, 3.0, 0.5]
    point = np.array([[[0.5, 2.0]], [[np.nan, np.nan]]])
    history = make_history(
        state, action, next_state, 0.02, point=point, point_frame="body"
    )
    np.testing.assert_allclose(history.action[:, 0, 2], [0.5 - 6.0 - 1.0, 0.5])


@pytest.mark.parametrize(
    ("frame", "place", "value"),
    [("world", 1, None), ("body", 2, None), ("world", 0, 1)],
)
def test_a_torque_about_what_was_not_seen_is_refused(frame, place, value):
    """A position, an angle that turns the point, half a point."""
    state, action, next_state = rows(3)
    point = np.ones((3, 1, 2))
    if value is None:
        state[1, 0, place] = np.nan
    else:
        point[1, 0, place] = np.nan
    with pytest.raises(ValueError, match=r"point: .* body 0 .* row 1"):
        make_history(state, action, next_state, 0.02, point=point, point_frame=frame)
    # Where nothing pushes nothing is asked.
    action[1, 0, :2] = 0.0
    make_history(state, action, next_state, 0.02, point=point, point_frame=frame)


def test_a_point_that_is_measured_does_not_mind_where_the_mass_is():
    """A push at the centre of mass, told as a point, turns nothing."""
    half, center = [0.3, 0.2], np.array([0.1, -0.05])
    spec = scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": 0.001,
            "bodies": [
                {
                    "name": "box",
                    "density": 20.0,
                    "shape": {"type": "box", "half_extents": half},
                }
            ],
        }
    )
    params = dataclasses.replace(
        spec.params(), center_of_mass=jnp.asarray(center[None], float)
    )
    pose = jnp.array([[0.4, -0.2, 0.9]])
    start = State(pose, jnp.zeros((1, 3)))
    force = jnp.array([[5.0, 2.0, 0.0]])

    def spin(point):
        wrench = wrench_at_reference(force, point[None], pose, frame="body")
        return float(step(spec.scene, params, start, wrench)[0].twist[0, 2])

    mass = 20.0 * 0.24
    inertia = mass * (half[0] ** 2 + half[1] ** 2) / 3.0
    assert abs(spin(jnp.asarray(center, float))) < 1e-12
    # A lever of 0.2 m along the body's x axis; only the force across it counts.
    across = -np.sin(0.9) * 5.0 + np.cos(0.9) * 2.0
    expected = 0.2 * across / inertia * 0.001
    np.testing.assert_allclose(
        spin(jnp.asarray(center + np.array([0.2, 0.0]), float)), expected, rtol=1e-6
    )
