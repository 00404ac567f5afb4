"""A body without constraints obeys Newton's laws, to rounding."""

import jax.numpy as jnp
import numpy as np

from boomdp_jax.physics import step
from tests.physics.scenes import make_params, make_scene, make_state, run
from tests.reference.planar_dynamics import World, energy, momentum

BRICK = World([(0.3, 0.1)], [20.0])
POSE = np.array([[0.4, -0.2, 0.7]])
TWIST = np.array([[0.5, -0.3, 1.1]])


def test_constant_wrench_and_gravity_give_a_parabola(precision):
    world = BRICK.with_(gravity=(0.3, -9.81))
    wrench = np.array([[3.0, 1.0, 0.2]])
    trajectory = run(world, POSE, TWIST, num_steps=50, wrench=wrench)
    time = 0.02 * np.arange(1, 51)[:, None, None]
    acceleration = np.array(
        [
            3.0 / world.mass[0] + 0.3,
            1.0 / world.mass[0] - 9.81,
            0.2 / world.inertia[0],
        ]
    )
    tolerance = precision.choose(single=2e-5, double=1e-12)
    expected = POSE + TWIST * time + 0.5 * acceleration * time**2
    np.testing.assert_allclose(
        trajectory.pose, expected, rtol=tolerance, atol=tolerance
    )
    np.testing.assert_allclose(
        trajectory.twist,
        TWIST + acceleration * time,
        rtol=tolerance,
        atol=tolerance,
    )
    assert trajectory.is_finite.all()
    assert np.all(trajectory.constraint_error == 0.0)


def test_free_flight_conserves_momentum_and_energy(precision):
    world = World([(0.3, 0.1), (0.2, 0.2)], [20.0, 7.0])
    pose = np.array([[0.4, -0.2, 0.7], [3.0, 1.0, -2.0]])
    twist = np.array([[0.5, -0.3, 6.0], [-0.4, 0.1, -3.0]])
    trajectory = run(world, pose, twist, num_steps=50)
    rtol = precision.choose(single=1e-5, double=1e-12)
    start = momentum(world, pose, twist)
    drift = momentum(world, trajectory.pose, trajectory.twist) - start
    assert np.max(np.abs(drift)) < rtol * np.max(np.abs(start))
    energies = energy(world, trajectory.pose, trajectory.twist)
    np.testing.assert_allclose(energies, energy(world, pose, twist), rtol=rtol)


def test_torque_free_body_turns_past_many_revolutions_unwrapped(precision):
    trajectory = run(BRICK, POSE, [[0.0, 0.0, 40.0]], num_steps=100)
    expected = 0.7 + 40.0 * 0.02 * np.arange(1, 101)
    rtol = precision.choose(single=1e-5, double=1e-12)
    np.testing.assert_allclose(trajectory.pose[:, 0, 2], expected, rtol=rtol)


def test_static_body_stays_where_it_is_under_any_load(precision):
    world = BRICK.with_(gravity=(0.0, -9.81))
    scene, params = make_scene(world), make_params(world)
    held = type(scene)(**{**vars(scene), "is_static": jnp.ones(1, bool)})
    state = make_state(POSE)
    wrench = jnp.asarray([[30.0, -20.0, 5.0]], float)
    next_state, info = step(held, params, state, wrench)
    np.testing.assert_array_equal(next_state.pose, state.pose)
    np.testing.assert_array_equal(next_state.twist, state.twist)
    assert info.is_finite


def test_impulse_does_not_depend_on_step_length():
    wrench = np.array([[3.0, 1.0, 0.2]])
    coarse = run(BRICK, POSE, TWIST, num_steps=50, dt=0.04, wrench=wrench)
    fine = run(BRICK, POSE, TWIST, num_steps=100, dt=0.02, wrench=wrench)
    np.testing.assert_allclose(coarse.pose[-1], fine.pose[-1], atol=1e-12)
    np.testing.assert_allclose(coarse.twist[-1], fine.twist[-1], atol=1e-12)
