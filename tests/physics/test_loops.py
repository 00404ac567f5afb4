"""Closed loops: four-bar linkages move with their one degree of freedom."""

import itertools

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.physics.scenes import convergence_orders, run
from tests.reference.planar_dynamics import (
    Pin,
    World,
    anchor_gap,
    drift,
    energy,
    integrate,
)

# Three bodies and four pins compile for about half a minute.
pytestmark = pytest.mark.slow

CRANK, COUPLER = 0.5, 0.6


def parallelogram() -> World:
    """Two equal hanging cranks that carry a coupler, all pinned together."""
    half, width = 0.5 * CRANK, 0.5 * COUPLER
    return World(
        [(half, 0.02), (width, 0.03), (half, 0.02)],
        [30.0, 25.0, 30.0],
        gravity=(0.0, -9.81),
        pins=[
            Pin(0, (-half, 0.0), (0.0, 0.0)),
            Pin(0, (half, 0.0), (-width, 0.0), b=1),
            Pin(1, (width, 0.0), (half, 0.0), b=2),
            Pin(2, (-half, 0.0), (COUPLER, 0.0)),
        ],
    )


def parallelogram_pose(angle: float) -> np.ndarray:
    """Poses of crank, coupler and crank at an angle from hanging."""
    theta = angle - 0.5 * np.pi
    tip = CRANK * np.array([np.cos(theta), np.sin(theta)])
    return np.array(
        [
            [0.5 * tip[0], 0.5 * tip[1], theta],
            [tip[0] + 0.5 * COUPLER, tip[1], 0.0],
            [0.5 * tip[0] + COUPLER, 0.5 * tip[1], theta],
        ]
    )


def parallelogram_angle(world: World, angle: float, times) -> np.ndarray:
    """Angle of the equivalent pendulum: the coupler moves as a point at the tip."""
    inertia = 2 * (world.inertia[0] + world.mass[0] * (0.5 * CRANK) ** 2)
    inertia += world.mass[1] * CRANK**2
    torque = 9.81 * CRANK * (world.mass[0] + world.mass[1])
    solution = solve_ivp(
        lambda _, y: [y[1], -torque / inertia * np.sin(y[0])],
        (0.0, times[-1]),
        [angle, 0.0],
        t_eval=times,
        rtol=1e-10,
        atol=1e-12,
    )
    return solution.y[0]


def test_parallelogram_swings_like_its_pendulum_to_second_order():
    world = parallelogram()
    errors = []
    for dt in (0.02, 0.01, 0.005):
        num_steps = round(1.0 / dt)
        trajectory = run(world, parallelogram_pose(1.0), num_steps=num_steps, dt=dt)
        times = dt * np.arange(1, num_steps + 1)
        expected = parallelogram_angle(world, 1.0, times) - 0.5 * np.pi
        errors.append(float(np.max(np.abs(trajectory.pose[:, 0, 2] - expected))))
    assert errors[0] < 0.02
    assert np.all(convergence_orders(errors) > 1.8), errors


def test_parallelogram_holds_its_joints_and_its_energy(precision):
    world = parallelogram()
    start = parallelogram_pose(1.0)
    trajectory = run(world, start, num_steps=250)
    drifts = [drift(world, pose) for pose in trajectory.pose.astype(float)]
    assert np.max(drifts) < 1e-4
    assert np.max(np.abs(trajectory.pose[:, 1, 2])) < 1e-3
    lowest = energy(world, parallelogram_pose(0.0), np.zeros((3, 3)))
    energies = energy(world, trajectory.pose, trajectory.twist) - lowest
    first = energy(world, start, np.zeros((3, 3))) - lowest
    np.testing.assert_allclose(energies, first, rtol=0.01)


def crank_rocker() -> tuple[World, np.ndarray]:
    """Four unequal bars in a pose that closes the loop."""
    lengths = [0.3, 0.7, 0.5]
    corners = [np.zeros(2), np.array([0.2, 0.2236068])]
    corners[1] = 0.3 * corners[1] / np.linalg.norm(corners[1])
    base = np.array([0.6, -0.1])
    span = base - corners[1]
    reach = np.linalg.norm(span)
    cosine = (0.7**2 + reach**2 - 0.5**2) / (2 * 0.7 * reach)
    angle = np.arctan2(span[1], span[0]) + np.arccos(cosine)
    corners += [corners[1] + 0.7 * np.array([np.cos(angle), np.sin(angle)]), base]
    poses = []
    for first, last in itertools.pairwise(corners):
        bar = last - first
        poses.append([*(0.5 * (first + last)), np.arctan2(bar[1], bar[0])])
    half = [0.5 * length for length in lengths]
    world = World(
        [(length, 0.02) for length in half],
        [30.0, 20.0, 25.0],
        gravity=(0.0, -9.81),
        pins=[
            Pin(0, (-half[0], 0.0), (0.0, 0.0)),
            Pin(0, (half[0], 0.0), (-half[1], 0.0), b=1),
            Pin(1, (half[1], 0.0), (-half[2], 0.0), b=2),
            Pin(2, (half[2], 0.0), tuple(base)),
        ],
    )
    return world, np.array(poses)


def test_crank_rocker_follows_the_reference():
    world, pose = crank_rocker()
    gaps = [np.linalg.norm(anchor_gap(pin, pose)) for pin in world.pins]
    assert np.max(gaps) < 1e-12
    times = 0.005 * np.arange(1, 101)
    expected, _ = integrate(world, pose, np.zeros((3, 3)), times)
    trajectory = run(world, pose, num_steps=100, dt=0.005)
    np.testing.assert_allclose(trajectory.pose, expected, atol=3e-3)


def test_redundant_pins_hold_a_body_still(precision):
    world = World(
        [(0.3, 0.1), (0.2, 0.2), (0.2, 0.2)],
        [20.0, 10.0, 10.0],
        gravity=(0.0, -9.81),
        pins=[
            Pin(0, (-0.25, 0.0), (-0.25, 0.0)),
            Pin(0, (0.25, 0.0), (0.25, 0.0)),
        ],
    )
    pose = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    load = np.array([[5.0, 3.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    trajectory = run(world, pose, num_steps=50, wrench=load)
    assert trajectory.is_finite.all()
    np.testing.assert_allclose(trajectory.pose[-1, 0], 0.0, atol=1e-4)
    np.testing.assert_allclose(trajectory.twist[-1, 0], 0.0, atol=1e-3)
