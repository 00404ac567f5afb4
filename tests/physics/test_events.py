"""Events happen when closed forms say so."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics import State, scene_spec_from_dict
from boomdp_jax.physics.events import (
    contact_flags,
    fell_over,
    first_contact,
    first_time,
    reached_region,
)

DT = 0.02


def trajectory(pose) -> State:
    """Poses of one body over time, at rest."""
    pose = jnp.asarray(pose, float)[:, None]
    return State(pose=pose, twist=jnp.zeros_like(pose))


def drive():
    """A ball at 2 m/s through a wall 3 m away; another ball lies behind it."""

    def body(name, x, shape):
        return {"name": name, "pose": [x, 0, 0], "shape": shape}

    ball, wall = {"type": "circle", "radius": 0.25}, {"type": "box"}
    wall["half_extents"] = [0.1, 1.0]
    spec = scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": DT,
            "bodies": [
                body("ball", 0, ball),
                body("wall", 3, wall),
                body("o", -2, ball),
            ],
        }
    )
    pose = jnp.tile(spec.initial_state().pose, (75, 1, 1))
    pose = pose.at[:, 0, 0].set(2.0 * DT * jnp.arange(1, 76))
    return spec.scene, State(pose=pose, twist=jnp.zeros_like(pose))


@pytest.mark.parametrize(
    ("flags", "index", "time"),
    [
        ([False, False, True, False, True], 2, 0.06),
        ([True, False, False, False, False], 0, 0.02),
        ([False, False, False, False, True], 4, 0.1),
        ([False] * 5, 5, np.inf),
    ],
)
def test_the_first_flag_is_found(flags, index, time, precision):
    first = first_time(jnp.array(flags), DT)
    assert bool(first.has_happened) == (index < 5)
    assert int(first.index) == index
    np.testing.assert_allclose(first.time, time, rtol=1e-6)


def test_steps_of_different_length_add_up():
    first = first_time(jnp.array([False, False, True]), jnp.array([0.1, 0.02, 0.3]))
    np.testing.assert_allclose(first.time, 0.42)


def test_many_trajectories_are_searched_at_once():
    flags = np.random.default_rng(0).uniform(size=(64, 30)) > 0.96
    found = jax.jit(jax.vmap(first_time, in_axes=(0, None)))(jnp.asarray(flags), DT)
    expected = [row.tolist().index(True) if row.any() else 30 for row in flags]
    np.testing.assert_array_equal(found.index, expected)
    np.testing.assert_array_equal(found.has_happened, flags.any(axis=1))


def test_a_region_holds_its_rim_and_nothing_beyond():
    states = trajectory([[1, 2, 0], [3, 4, 9], [2, 3, 0], [3.01, 3, 0], [2, 1.99, 0]])
    flags = reached_region(states, 0, (1.0, 2.0), (3.0, 4.0))
    np.testing.assert_array_equal(flags, [True, True, True, False, False])
    array = reached_region(states, 0, jnp.array([1.0, 2.0]), jnp.array([3.0, 4.0]))
    np.testing.assert_array_equal(array, flags)


def test_a_ball_reaches_a_region_when_its_speed_says():
    _, states = drive()
    flags = jax.jit(reached_region)(states, 0, (1.99, -1.0), (5.0, 1.0))
    # At 0.04 m a step it is past 1.99 m first after step 50.
    np.testing.assert_allclose(first_time(flags, DT).time, 1.0, rtol=1e-12)
    assert not np.any(reached_region(states, 2, (1.99, -1.0), (5.0, 1.0)))


def test_a_lean_counts_either_way_and_without_full_turns():
    turn = 2.0 * np.pi
    angles = np.array([0.1, 0.5, 0.7, -0.4, -0.6, turn + 0.2, -3 * turn - 0.6, np.pi])
    states = trajectory(np.stack([0 * angles, 0 * angles, angles], axis=-1))
    fallen = fell_over(states, 0, 0.55)
    np.testing.assert_array_equal(fallen, [0, 0, 1, 0, 1, 0, 1, 1])
    upright = fell_over(states, 0, 0.55, upright=0.0)
    np.testing.assert_array_equal(upright, [0, 0, 1, 0, 1, 0, 1, 1])
    level = fell_over(states, 0, 0.55, upright=np.pi)
    np.testing.assert_array_equal(level, [1, 1, 1, 1, 1, 1, 1, 0])


def test_a_ball_touches_the_wall_when_its_rim_gets_there():
    scene, states = drive()
    find = jax.jit(first_contact)
    contact = find(scene, states, 0, 1, DT, margin=1e-9)
    # 3 - 0.1 - 0.25 = 2.65 m away, 0.04 m a step: apart after 66, not after 67.
    assert int(contact.index) == 66
    np.testing.assert_allclose(contact.time, 67 * DT)
    early = find(scene, states, 1, 0, DT, margin=0.5)
    assert int(early.index) == int(np.ceil(2.15 / 0.04)) - 1
    assert not find(scene, states, 0, 2, DT, margin=1e-9).has_happened


def test_contact_flags_are_symmetric_and_of_pairs_only():
    scene, states = drive()
    flags = np.asarray(jax.jit(contact_flags)(scene, states))
    assert flags.shape == (75, 3, 3)
    np.testing.assert_array_equal(flags, np.swapaxes(flags, 1, 2))
    assert not flags[:, np.arange(3), np.arange(3)].any()
    np.testing.assert_array_equal(flags[:, 0, 1], np.arange(75) >= 66)
    assert not flags[:, 2].any()
