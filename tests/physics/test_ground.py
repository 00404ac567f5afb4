"""Ground friction: stopping distance, sticking, and the quasi-static limit surface."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics import rollout
from tests.physics.scenes import make_params, make_scene, make_state, run
from tests.reference.planar_dynamics import Ground, World, friction_wrench, integrate

BRICK = World([(0.3, 0.1)], [20.0])
LEVEL = np.zeros((1, 3))
WEIGHT = BRICK.mass[0] * 9.81


def on_ground(friction: float, viscous: float = 1e4) -> World:
    return BRICK.with_(grounds=[Ground(0, friction, viscous)])


def test_sliding_box_stops_after_its_stopping_distance(precision):
    friction, speed = 0.3, 1.5
    trajectory = run(on_ground(friction), LEVEL, [[speed, 0, 0]], num_steps=50)
    slowing = friction * 9.81
    time = 0.02 * np.arange(1, 51)
    stop = speed / slowing
    sliding = time < stop - 0.04
    np.testing.assert_allclose(
        trajectory.twist[sliding, 0, 0], speed - slowing * time[sliding], atol=1e-4
    )
    assert np.max(np.abs(trajectory.twist[time > stop + 0.06])) < 1e-4
    assert abs(trajectory.pose[-1, 0, 0] - speed**2 / (2 * slowing)) < 2e-3


@pytest.mark.slow
def test_stopping_distance_converges_as_the_step_shrinks():
    friction, speed = 0.3, 1.5
    distance = speed**2 / (2 * friction * 9.81)
    errors = []
    for dt in (0.04, 0.01, 0.0025):
        num_steps = 50 * round(0.6 / dt / 50 + 0.5)
        trajectory = run(
            on_ground(friction, 1e6), LEVEL, [[speed, 0, 0]], dt=dt, num_steps=num_steps
        )
        errors.append(abs(trajectory.pose[-1, 0, 0] - distance))
    assert errors[-1] < 2e-5
    assert errors[0] < 0.3 * 9.81 * 0.04**2


def test_spinning_box_stops_under_the_torque_of_its_feet(precision):
    friction, spin = 0.3, 6.0
    radius = np.linalg.norm(BRICK.feet[0, 0])
    slowing = friction * 9.81 * radius / BRICK.gyration[0]
    trajectory = run(on_ground(friction), LEVEL, [[0, 0, spin]], num_steps=50)
    time = 0.02 * np.arange(1, 51)
    stop = spin / slowing
    assert stop < 0.8
    sliding = time < stop - 0.04
    np.testing.assert_allclose(
        trajectory.twist[sliding, 0, 2], spin - slowing * time[sliding], atol=1e-2
    )
    assert np.max(np.abs(trajectory.twist[time > stop + 0.06])) < 1e-3
    np.testing.assert_allclose(trajectory.pose[-1, 0, :2], 0.0, atol=1e-4)
    assert abs(trajectory.pose[-1, 0, 2] - spin**2 / (2 * slowing)) < 0.02


def test_box_that_is_pushed_too_weakly_stays(precision):
    viscous = 1e4
    force = 0.9 * 0.4 * WEIGHT
    world = on_ground(0.4, viscous)
    trajectory = run(world, LEVEL, num_steps=100, wrench=[[0.0, force, 0.0]])
    assert 0.0 < trajectory.pose[-1, 0, 1] < 1.05 * force / viscous * 2.0
    assert np.max(np.abs(trajectory.pose[-1, 0, [0, 2]])) < 1e-6


def test_box_that_is_pushed_hard_enough_accelerates_by_the_excess(precision):
    force = 1.5 * 0.4 * WEIGHT
    trajectory = run(on_ground(0.4), LEVEL, num_steps=50, wrench=[[force, 0, 0]])
    expected = 0.5 * 0.4 * 9.81 * 1.0
    assert abs(trajectory.twist[-1, 0, 0] - expected) < 5e-3


def test_ground_does_nothing_where_nothing_presses_on_it(precision):
    world = on_ground(0.4).with_(normal_gravity=0.0)
    trajectory = run(world, LEVEL, [[1.0, 0.5, 2.0]], num_steps=50)
    np.testing.assert_allclose(
        trajectory.twist[-1], [[1.0, 0.5, 2.0]], rtol=1e-5, atol=1e-6
    )


@pytest.mark.parametrize("viscous", [100.0, 1e4], ids=["soft", "stiff"])
def test_sliding_and_turning_box_follows_the_reference(viscous):
    world = on_ground(0.3, viscous)
    twist = np.array([[1.0, 0.3, 5.0]])
    times = np.array([0.1, 0.2, 0.3])
    expected, _ = integrate(world, LEVEL, twist, times, method="Radau", rtol=1e-7)
    trajectory = run(world, LEVEL, twist, num_steps=100, dt=0.005)
    np.testing.assert_allclose(trajectory.pose[[19, 39, 59]], expected, atol=2e-3)


def test_slow_pushes_do_not_reveal_mass_beyond_the_friction_limit():
    light = on_ground(0.4, 400.0)
    heavy = light.with_(density=[40.0], grounds=[Ground(0, 0.2, 400.0)])
    force = 0.5 * 0.4 * WEIGHT
    displacements = [
        run(world, LEVEL, num_steps=100, wrench=[[force, 0, 0]]).pose[-1, 0, 0]
        for world in (light, heavy)
    ]
    steady = force / 400.0 * 2.0
    transient = force / 400.0 * heavy.mass[0] / 400.0
    np.testing.assert_allclose(displacements, steady, atol=1.1 * transient)


@pytest.mark.slow
def test_slow_pushes_obey_the_quasi_static_limit_surface():
    world = on_ground(0.4, 1e6)
    generator = np.random.default_rng(1)
    twists = generator.normal(size=(32, 3)) * [1.0, 1.0, 4.0]
    limits = np.stack(
        [-friction_wrench(world, LEVEL, twist[None])[0] for twist in twists]
    )
    scene, params, state = make_scene(world), make_params(world), make_state(LEVEL)

    @jax.jit
    @jax.vmap
    def push(wrench):
        states, _ = rollout(scene, params, state, jnp.tile(wrench, (10, 1, 1)))
        return states.twist[-1, 0]

    held = push(jnp.asarray(0.95 * limits))
    moved = push(jnp.asarray(1.05 * limits))
    assert np.max(np.abs(held)) < 2e-3
    power = np.sum(np.asarray(moved) * limits, axis=-1)
    assert np.all(power > 0.02), power.min()
