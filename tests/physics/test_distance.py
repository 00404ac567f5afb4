"""Rods: a point on a rod is a simple pendulum, and a rod does no work."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.physics.scenes import convergence_orders, run
from tests.reference.planar_dynamics import (
    Pin,
    Rod,
    World,
    drift,
    energy,
    integrate,
    momentum,
)

LENGTH = 0.6


def bob(anchor: tuple[float, float] = (0.0, 0.0)) -> World:
    """A brick on a rod from the origin."""
    rod = Rod(0, anchor, (0.0, 0.0), LENGTH)
    return World([(0.1, 0.1)], [50.0], gravity=(0.0, -9.81), rods=[rod])


def swung(angle: float) -> np.ndarray:
    return np.array([[LENGTH * np.sin(angle), -LENGTH * np.cos(angle), 0.0]])


def test_bob_on_a_rod_is_a_simple_pendulum_to_second_order():
    errors = []
    for dt in (0.02, 0.01, 0.005):
        num_steps = round(2.0 / dt)
        times = dt * np.arange(1, num_steps + 1)
        solution = solve_ivp(
            lambda _, y: [y[1], -9.81 / LENGTH * np.sin(y[0])],
            (0.0, times[-1]),
            [1.2, 0.0],
            t_eval=times,
            rtol=1e-10,
            atol=1e-12,
        )
        expected = LENGTH * np.array([np.sin(solution.y[0]), -np.cos(solution.y[0])]).T
        trajectory = run(bob(), swung(1.2), num_steps=num_steps, dt=dt)
        errors.append(float(np.max(np.abs(trajectory.pose[:, 0, :2] - expected))))
        assert np.max(np.abs(trajectory.pose[:, 0, 2])) < 1e-9
    assert errors[0] < 0.02
    assert np.all(convergence_orders(errors) > 1.8), errors


@pytest.mark.slow
def test_rod_holds_under_load(precision):
    load = np.random.default_rng(2).normal(size=(1000, 1, 3)) * [20.0, 20.0, 1.0]
    world = bob((0.05, 0.08))
    pose = np.array([[-0.05, -0.08 - LENGTH, 0.0]])
    trajectory = run(world, pose, num_steps=1000, wrench=load)
    drifts = [drift(world, pose) for pose in trajectory.pose.astype(float)]
    assert np.max(drifts) < 1e-4
    assert np.max(trajectory.constraint_error) < 1e-4
    assert trajectory.is_finite.all()


@pytest.mark.slow
def test_off_centre_rod_follows_the_reference_and_keeps_energy(precision):
    world = bob((0.1, 0.1))
    pose = np.array([[0.5, -0.1, 0.0]])
    trajectory = run(world, pose, num_steps=200, dt=0.005)
    expected, _ = integrate(world, pose, np.zeros((1, 3)), np.array([0.25, 0.5]))
    assert abs(drift(world, pose)) < 1e-12
    np.testing.assert_allclose(trajectory.pose[[49, 99]], expected, atol=1e-3)
    energies = energy(world, trajectory.pose, trajectory.twist)
    start = energy(world, pose, np.zeros((1, 3)))
    assert np.max(np.abs(energies - start)) < 0.01 * world.mass[0] * 9.81 * LENGTH


def test_off_centre_rod_converges_to_second_order():
    world, pose = bob((0.1, 0.1)), np.array([[0.5, -0.1, 0.0]])
    errors = []
    for dt in (0.01, 0.005, 0.0025):
        num_steps = round(1.0 / dt)
        trajectory = run(world, pose, num_steps=num_steps, dt=dt)
        expected, _ = integrate(world, pose, np.zeros((1, 3)), np.array([1.0]))
        errors.append(float(np.max(np.abs(trajectory.pose[-1] - expected[0]))))
    assert np.all(convergence_orders(errors) > 1.8), errors


@pytest.mark.slow
def test_rod_between_two_bodies_conserves_momentum(precision):
    rod = Rod(0, (0.1, 0.0), (-0.2, 0.0), 0.5, b=1)
    world = World([(0.3, 0.1), (0.2, 0.15)], [20.0, 30.0], rods=[rod])
    pose = np.array([[0.0, 0.0, 0.0], [0.8, 0.0, 0.0]])
    twist = np.array([[0.2, 1.0, 0.0], [0.2, -1.0, 0.0]])
    trajectory = run(world, pose, twist, num_steps=100)
    start = momentum(world, pose, twist)
    now = momentum(world, trajectory.pose, trajectory.twist)
    linear = precision.choose(single=1e-4, double=1e-11)
    np.testing.assert_allclose(now[:, :2], np.tile(start[:2], (100, 1)), atol=linear)
    np.testing.assert_allclose(now[:, 2], start[2], atol=2e-3 * abs(start[2]))


def test_rod_of_no_length_is_finite_and_acts_as_a_pin():
    rod = Rod(0, (0.1, 0.1), (0.0, 0.0), 0.0)
    world = World([(0.1, 0.1)], [50.0], gravity=(0.0, -9.81), rods=[rod])
    pose = np.array([[-0.1, -0.1, 0.0]])
    trajectory = run(world, pose, num_steps=50)
    assert trajectory.is_finite.all()
    assert np.all(np.isfinite(trajectory.pose))
    assert np.all(np.isfinite(trajectory.twist))


@pytest.mark.slow
def test_rod_and_pin_together_leave_no_freedom(precision):
    world = World(
        [(0.3, 0.1)],
        [20.0],
        gravity=(0.0, -9.81),
        pins=[Pin(0, (-0.25, 0.0), (0.0, 0.0))],
        rods=[Rod(0, (0.25, 0.0), (0.5, 0.4), 0.4)],
    )
    pose = np.array([[0.25, 0.0, 0.0]])
    trajectory = run(world, pose, num_steps=50)
    np.testing.assert_allclose(trajectory.pose[-1], pose, atol=1e-6)
    np.testing.assert_allclose(trajectory.twist[-1], 0.0, atol=1e-6)
