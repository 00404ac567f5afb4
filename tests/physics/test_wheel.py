"""Wheels: drag, dry sliding, and the non-holonomic limit."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.physics.scenes import convergence_orders, run
from tests.reference.planar_dynamics import Pin, Wheel, World, energy, integrate

BRICK = World([(0.3, 0.1)], [20.0])
LEVEL = np.zeros((1, 3))


def with_wheel(*wheels: Wheel) -> World:
    return BRICK.with_(wheels=list(wheels))


def test_viscous_wheel_decays_exponentially_along_its_own_axes(precision):
    rolling, lateral = 1.2, 6.0
    world = with_wheel(Wheel(0, (0.0, 0.0), 0.0, (rolling, lateral)))
    trajectory = run(world, LEVEL, [[1.0, -0.8, 0.0]], num_steps=50)
    time = 0.02 * np.arange(1, 51)
    rate = np.array([rolling, lateral]) / world.mass[0]
    expected = np.array([1.0, -0.8]) * np.exp(-rate * time[:, None])
    np.testing.assert_allclose(trajectory.twist[:, 0, :2], expected, atol=2e-4)
    np.testing.assert_allclose(trajectory.twist[:, 0, 2], 0.0, atol=1e-6)
    path = np.array([1.0, -0.8]) * (1 - np.exp(-rate * time[:, None])) / rate
    np.testing.assert_allclose(trajectory.pose[:, 0, :2], path, atol=2e-4)


def test_viscous_wheel_off_centre_converges_to_second_order():
    world = with_wheel(Wheel(0, (-0.2, 0.05), 0.3, (1.2, 24.0)))
    twist = np.array([[0.8, -0.3, 3.0]])
    errors = []
    for dt in (0.02, 0.01, 0.005):
        num_steps = round(1.0 / dt)
        trajectory = run(world, LEVEL, twist, dt=dt, num_steps=num_steps)
        times = dt * np.arange(1, num_steps + 1)
        expected, _ = integrate(world, LEVEL, twist, times)
        errors.append(float(np.max(np.abs(trajectory.pose - expected))))
    assert errors[0] < 2e-3
    assert np.all(convergence_orders(errors) > 1.8), errors


def test_stiff_wheel_neither_oscillates_nor_overshoots(precision):
    world = with_wheel(Wheel(0, (0.0, 0.0), 0.0, (0.0, 1e6)))
    trajectory = run(world, LEVEL, [[1.0, 1.0, 0.0]], num_steps=50)
    lateral = trajectory.twist[:, 0, 1]
    assert abs(lateral[0]) < 0.01
    assert np.max(np.abs(lateral[2:])) < 1e-5
    rtol = precision.choose(single=1e-5, double=1e-9)
    np.testing.assert_allclose(trajectory.twist[:, 0, 0], 1.0, rtol=rtol)


def test_dry_wheel_slows_linearly_to_rest(precision):
    limit = 1.5
    world = with_wheel(Wheel(0, (0.0, 0.0), 0.4, (1e4, 1e4), (limit, limit)))
    trajectory = run(world, LEVEL, [[0.6, 0.8, 0.0]], num_steps=100)
    time = 0.02 * np.arange(1, 101)
    slowing = limit / world.mass[0]
    stop = 1.0 / slowing
    assert stop < 1.8
    speed = np.linalg.norm(trajectory.twist[:, 0, :2], axis=-1)
    sliding = time < stop - 0.04
    np.testing.assert_allclose(speed[sliding], 1 - slowing * time[sliding], atol=1e-4)
    assert np.max(speed[time > stop + 0.06]) < 1e-4
    reach = 0.5 / slowing
    np.testing.assert_allclose(
        trajectory.pose[-1, 0, :2], reach * np.array([0.6, 0.8]), atol=1e-3
    )


def test_unequal_dry_limits_scale_the_force_onto_their_ellipse(precision):
    limits = np.array([1.0, 3.0])
    world = with_wheel(Wheel(0, (0.0, 0.0), 0.0, (1e4, 1e4), tuple(limits)))
    direction = np.array([np.cos(0.7), np.sin(0.7)])
    trajectory = run(world, LEVEL, [[*(2.0 * direction), 0.0]], num_steps=50)
    force = 1.0 / np.linalg.norm(direction / limits)
    expected = 2.0 - force / world.mass[0] * 0.02 * np.arange(1, 51)
    np.testing.assert_allclose(
        trajectory.twist[:, 0, :2], expected[:, None] * direction, atol=1e-3
    )


def test_maximal_dissipation_when_viscosity_goes_with_the_limits_squared():
    limits = np.array([1.0, 3.0])
    viscous = tuple(1e4 * limits**2)
    world = with_wheel(Wheel(0, (0.0, 0.0), 0.0, viscous, tuple(limits)))
    velocity = np.array([1.0, 1.0])
    dt = 1e-4
    trajectory = run(world, LEVEL, [[*velocity, 0.0]], num_steps=50, dt=dt)
    force = -(limits**2) * velocity / np.linalg.norm(limits * velocity)
    change = trajectory.twist[-1, 0, :2] - velocity
    expected = force / world.mass[0] * 50 * dt
    np.testing.assert_allclose(change, expected, rtol=5e-3)


@pytest.mark.parametrize(
    "wheel",
    [
        Wheel(0, (-0.2, 0.05), 0.3, (0.4, 8.0)),
        Wheel(0, (-0.2, 0.05), 0.3, (4.0, 80.0), (0.5, 2.0)),
        Wheel(0, (0.5, -0.3), -1.2, (0.0, 8.0), (np.inf, 1.0)),
    ],
    ids=["viscous", "dry", "outside the outline"],
)
def test_wheel_off_centre_follows_the_reference(wheel):
    world = with_wheel(wheel)
    twist = np.array([[0.8, -0.3, 1.5]])
    wrench = np.array([[1.0, 0.5, 0.1]])
    times = np.array([0.5, 1.0])
    expected, rates = integrate(
        world, LEVEL, twist, times, wrench=wrench, method="Radau", rtol=1e-8
    )
    trajectory = run(world, LEVEL, twist, num_steps=200, dt=0.005, wrench=wrench)
    np.testing.assert_allclose(trajectory.pose[[99, 199]], expected, atol=2e-3)
    np.testing.assert_allclose(trajectory.twist[[99, 199]], rates, atol=5e-3)


def sleigh(arm: float, lateral: float = 1e7) -> World:
    """Chaplygin's sleigh: a knife edge at a distance behind the centre of mass."""
    return with_wheel(Wheel(0, (-arm, 0.0), 0.0, (0.0, lateral)))


def sleigh_path(world: World, arm: float, speed: float, spin: float, times):
    """Pose from v' = a w², w' = -m a v w / (I + m a²), v along the edge."""
    mass, inertia = world.mass[0], world.inertia[0]

    def rate(_, y):
        v, w, _, _, theta = y
        velocity = [
            v * np.cos(theta) - arm * w * np.sin(theta),
            v * np.sin(theta) + arm * w * np.cos(theta),
        ]
        turning = -mass * arm * v * w / (inertia + mass * arm**2)
        return [arm * w**2, turning, *velocity, w]

    solution = solve_ivp(
        rate,
        (0.0, times[-1]),
        [speed, spin, 0.0, 0.0, 0.0],
        t_eval=times,
        rtol=1e-10,
        atol=1e-12,
    )
    return solution.y[2:].T


def test_very_stiff_wheel_is_a_non_holonomic_constraint(precision):
    arm, speed, spin = 0.2, 0.3, 3.0
    world = sleigh(arm)
    twist = np.array([[speed, arm * spin, spin]])
    trajectory = run(world, LEVEL, twist, num_steps=100, dt=0.01)
    theta = trajectory.pose[:, 0, 2]
    vx, vy, rate = trajectory.twist[:, 0].T
    slip = -np.sin(theta) * vx + np.cos(theta) * vy - arm * rate
    assert np.max(np.abs(slip)) < 1e-4
    expected = sleigh_path(world, arm, speed, spin, 0.01 * np.arange(1, 101))
    np.testing.assert_allclose(trajectory.pose[:, 0], expected, atol=2e-3)
    energies = energy(world, trajectory.pose, trajectory.twist)
    np.testing.assert_allclose(energies, energy(world, LEVEL, twist), rtol=2e-3)


def test_sleigh_converges_to_second_order():
    arm, speed, spin = 0.2, 0.3, 3.0
    world = sleigh(arm)
    twist = np.array([[speed, arm * spin, spin]])
    errors = []
    for dt in (0.02, 0.01, 0.005):
        num_steps = round(1.0 / dt)
        trajectory = run(world, LEVEL, twist, num_steps=num_steps, dt=dt)
        times = dt * np.arange(1, num_steps + 1)
        expected = sleigh_path(world, arm, speed, spin, times)
        errors.append(float(np.max(np.abs(trajectory.pose[:, 0] - expected))))
    assert np.all(convergence_orders(errors) > 1.7), errors


def test_coefficient_keeps_its_meaning_when_the_step_changes():
    world = with_wheel(Wheel(0, (-0.2, 0.05), 0.3, (0.4, 30.0)))
    twist = np.array([[0.8, -0.3, 1.5]])
    coarse = run(world, LEVEL, twist, num_steps=50, dt=0.02)
    fine = run(world, LEVEL, twist, num_steps=200, dt=0.005)
    np.testing.assert_allclose(coarse.pose[-1], fine.pose[-1], atol=2e-3)


@pytest.mark.parametrize("pins", [[], [Pin(0, (0.25, 0.05), (0.25, 0.05))]])
@pytest.mark.parametrize("spin", [40.0, 63.0, 90.0, 200.0])
def test_friction_takes_energy_from_a_body_however_fast_it_spins(pins, spin):
    """At 20 Hz, several revolutions within a step included.

    Between two frames that differ by half a radian a single step may give a little.
    """
    arm = np.array([-0.05, 0.25]) if pins else np.array([0.02, 0.01])
    wheel = Wheel(0, (-0.2, 0.1), 0.4, (3.0, 200.0), (2.0, 2000.0))
    world = with_wheel(wheel).with_(pins=pins)
    twist = np.array([[*-spin * arm, spin]])
    trajectory = run(world, LEVEL, twist, num_steps=50, dt=0.05, num_substeps=1)
    energies = energy(world, trajectory.pose, trajectory.twist)
    before = np.append(energy(world, LEVEL, twist), energies[:-1])
    assert np.all(energies <= 1.05 * before), energies / before
    assert energies[-1] < 0.5 * energy(world, LEVEL, twist)
