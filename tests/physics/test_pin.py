"""Pins: pendulums against their own equations, drift, and what a pin conserves."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.physics.scenes import CHUNK, convergence_orders, run
from tests.reference.planar_dynamics import (
    Pin,
    World,
    drift,
    energy,
    integrate,
    momentum,
)

ARM = 0.25
PIVOT = (0.1, 0.2)


def pendulum(*, gravity: float = 9.81, viscous: float = 0.0, dry: float = np.inf):
    """A brick that hangs from one of its ends."""
    pin = Pin(0, (-ARM, 0.0), PIVOT, viscous=viscous, dry=dry)
    return World([(0.3, 0.1)], [20.0], gravity=(0.0, -gravity), pins=[pin])


def swung(angle: float, spin: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Pose and twist of that brick at an angle from hanging, turning about the pin."""
    theta = angle - 0.5 * np.pi
    arm = ARM * np.array([np.cos(theta), np.sin(theta)])
    pose = np.array([[PIVOT[0] + arm[0], PIVOT[1] + arm[1], theta]])
    return pose, np.array([[-spin * arm[1], spin * arm[0], spin]])


def angle_ode(world: World, angle: float, spin: float, times) -> np.ndarray:
    """Angle from hanging: I a'' = -m g l sin(a) - clip(c a', +-dry)."""
    inertia = world.inertia[0] + world.mass[0] * ARM**2
    weight = -world.mass[0] * world.gravity[1] * ARM
    pin = world.pins[0]

    def rate(_, y):
        friction = np.clip(pin.viscous * y[1], -pin.dry, pin.dry)
        return [y[1], (-weight * np.sin(y[0]) - friction) / inertia]

    solution = solve_ivp(
        rate,
        (0.0, times[-1]),
        [angle, spin],
        t_eval=times,
        method="Radau",
        rtol=1e-9,
        atol=1e-11,
    )
    return solution.y[0]


def angle_errors(world: World, angle: float, time_steps: list[float], spin=0.0):
    """Root mean square error of the angle over two seconds, for each step length."""
    errors = []
    for dt in time_steps:
        num_steps = round(2.0 / dt)
        trajectory = run(world, *swung(angle, spin), dt=dt, num_steps=num_steps)
        expected = angle_ode(world, angle, spin, dt * np.arange(1, num_steps + 1))
        error = trajectory.pose[:, 0, 2] + 0.5 * np.pi - expected
        errors.append(float(np.sqrt(np.mean(error**2))))
    return errors


@pytest.mark.parametrize("viscous", [0.0, 0.3], ids=["frictionless", "viscous"])
def test_pendulum_follows_its_equation_to_second_order(viscous):
    errors = angle_errors(pendulum(viscous=viscous), 1.5, [0.02, 0.01, 0.005])
    assert errors[0] < 0.02
    assert np.all(convergence_orders(errors) > 1.8), errors


def test_pendulum_follows_its_equation_in_both_precisions(precision):
    assert angle_errors(pendulum(viscous=0.3), 1.5, [0.01])[0] < 5e-3


def test_dry_joint_friction_follows_its_equation_to_first_order():
    world = pendulum(viscous=20.0, dry=0.8)
    errors = angle_errors(world, 1.5, [0.02, 0.01, 0.005])
    assert errors[0] < 0.03
    assert errors[-1] < 0.5 * errors[0], errors


def test_dry_joint_friction_stops_a_level_pendulum_linearly(precision):
    world = pendulum(gravity=0.0, viscous=50.0, dry=0.4)
    inertia = world.inertia[0] + world.mass[0] * ARM**2
    spin = 1.5
    trajectory = run(world, *swung(0.3, spin), num_steps=100)
    time = 0.02 * np.arange(1, 101)
    stop = spin * inertia / 0.4
    assert stop < 1.5
    expected = spin - 0.4 / inertia * time
    sliding = time < stop - 0.04
    np.testing.assert_allclose(
        trajectory.twist[sliding, 0, 2], expected[sliding], atol=1e-3
    )
    assert np.max(np.abs(trajectory.twist[time > stop + 0.1, 0, 2])) < 1e-3
    turned = trajectory.pose[-1, 0, 2] + 0.5 * np.pi - 0.3
    assert abs(turned - 0.5 * spin * stop) < 0.01


def test_dry_joint_friction_holds_a_pendulum_that_is_too_light_to_slip(precision):
    world = pendulum(viscous=2e3, dry=3.0)
    torque = world.mass[0] * 9.81 * ARM * np.sin(0.3)
    assert torque < 3.0
    trajectory = run(world, *swung(0.3), num_steps=100)
    creep = torque / 2e3 * 2.0
    turned = trajectory.pose[-1, 0, 2] - trajectory.pose[0, 0, 2]
    assert abs(turned) < 1.05 * creep + 1e-5


def test_frictionless_pendulum_keeps_its_energy(precision):
    world = pendulum()
    pose, twist = swung(2.0)
    trajectory = run(world, pose, twist, num_steps=250)
    lowest = energy(world, *swung(0.0))
    start = energy(world, pose, twist) - lowest
    now = energy(world, trajectory.pose, trajectory.twist) - lowest
    assert np.max(np.abs(now / start - 1.0)) < 0.01


def test_pin_drifts_less_than_a_tenth_of_a_millimetre_under_load(precision):
    world = pendulum()
    load = np.random.default_rng(0).normal(size=(1000, 1, 3)) * [40.0, 40.0, 4.0]
    trajectory = run(world, *swung(1.0, 3.0), num_steps=1000, wrench=load)
    drifts = [drift(world, pose) for pose in trajectory.pose.astype(float)]
    assert np.max(np.abs(trajectory.twist[:, 0, 2])) > 5.0
    assert np.max(drifts) < 1e-4
    assert np.max(trajectory.constraint_error) < 1e-4
    assert trajectory.is_finite.all()


def test_constraint_error_reports_the_drift_that_is_there():
    world = pendulum()
    trajectory = run(world, *swung(1.0, 3.0), num_steps=50)
    drifts = [drift(world, pose) for pose in trajectory.pose]
    np.testing.assert_allclose(trajectory.constraint_error, drifts, atol=1e-9)


def test_anchor_point_of_a_pinned_body_does_not_move(precision):
    world = pendulum()
    trajectory = run(world, *swung(1.0, 3.0), num_steps=50)
    theta = trajectory.pose[:, 0, 2]
    rate = trajectory.twist[:, 0]
    slip = np.stack(
        [
            rate[:, 0] + rate[:, 2] * ARM * np.sin(theta),
            rate[:, 1] - rate[:, 2] * ARM * np.cos(theta),
        ]
    )
    assert np.max(np.abs(slip)) < precision.choose(single=1e-4, double=1e-6)


JOINED = World(
    [(0.3, 0.1), (0.2, 0.15)],
    [20.0, 30.0],
    pins=[Pin(0, (0.28, 0.0), (-0.18, 0.05), b=1)],
)


def joined_start() -> tuple[np.ndarray, np.ndarray]:
    """Two joined bodies that fly and turn against each other."""
    pose = np.array([[0.1, 0.2, 0.0], [0.1 + 0.28 + 0.18, 0.2 - 0.05, 0.0]])
    spin_a, spin_b = 2.0, -3.0
    velocity = np.array([0.4, -0.1])
    corner = velocity + spin_a * np.array([0.0, 0.28])
    other = corner - spin_b * np.array([-0.05, -0.18])
    return pose, np.array([[*velocity, spin_a], [*other, spin_b]])


@pytest.mark.slow
def test_two_joined_bodies_conserve_momentum(precision):
    pose, twist = joined_start()
    trajectory = run(JOINED, pose, twist, num_steps=100)
    start = momentum(JOINED, pose, twist)
    now = momentum(JOINED, trajectory.pose, trajectory.twist)
    linear = precision.choose(single=1e-4, double=1e-11)
    np.testing.assert_allclose(now[:, :2], np.tile(start[:2], (100, 1)), atol=linear)
    np.testing.assert_allclose(now[:, 2], start[2], atol=2e-3 * abs(start[2]))
    drifts = [drift(JOINED, pose) for pose in trajectory.pose.astype(float)]
    assert np.max(drifts) < 1e-4


@pytest.mark.slow
def test_angular_momentum_of_joined_bodies_converges_to_second_order():
    pose, twist = joined_start()
    start = momentum(JOINED, pose, twist)[2]
    errors = []
    for dt in (0.02, 0.01, 0.005):
        trajectory = run(JOINED, pose, twist, dt=dt, num_steps=round(2.0 / dt))
        now = momentum(JOINED, trajectory.pose, trajectory.twist)[:, 2]
        errors.append(float(np.max(np.abs(now - start))) + 1e-14)
    assert errors[0] < 1e-8 or np.all(convergence_orders(errors) > 1.8), errors


DOUBLE = World(
    [(0.2, 0.05), (0.25, 0.05)],
    [30.0, 20.0],
    gravity=(0.0, -9.81),
    pins=[
        Pin(0, (-0.2, 0.0), (0.0, 0.0)),
        Pin(0, (0.2, 0.0), (-0.25, 0.0), b=1),
    ],
)
DOUBLE_START = np.array([[0.2, 0.0, 0.0], [0.65, 0.0, 0.0]])


@pytest.mark.slow
def test_double_pendulum_keeps_its_energy(precision):
    trajectory = run(DOUBLE, DOUBLE_START, num_steps=200, dt=0.01)
    now = energy(DOUBLE, trajectory.pose, trajectory.twist)
    start = energy(DOUBLE, DOUBLE_START, np.zeros((2, 3)))
    depth = DOUBLE.mass * 9.81 * np.array([0.2, 0.65])
    assert np.max(np.abs(now - start)) < 0.01 * depth.sum()


@pytest.mark.slow
def test_double_pendulum_follows_lagrange_multipliers_to_second_order():
    errors = []
    for dt in (0.02, 0.01, 0.005):
        num_steps = round(1.0 / dt)
        trajectory = run(DOUBLE, DOUBLE_START, num_steps=num_steps, dt=dt)
        times = dt * np.arange(1, num_steps + 1)
        pose, _ = integrate(DOUBLE, DOUBLE_START, np.zeros((2, 3)), times)
        errors.append(float(np.max(np.abs(trajectory.pose - pose))))
    assert errors[-1] < 5e-3
    assert np.all(convergence_orders(errors) > 1.7), errors


@pytest.mark.slow
def test_friction_between_two_bodies_acts_on_both():
    pin = Pin(0, (0.28, 0.0), (-0.18, 0.05), b=1, viscous=0.2)
    world = JOINED.with_(pins=[pin])
    pose, twist = joined_start()
    trajectory = run(world, pose, twist, num_steps=200, dt=0.005)
    expected, _ = integrate(world, pose, twist, np.array([0.5, 1.0]))
    np.testing.assert_allclose(trajectory.pose[[99, 199]], expected, atol=1e-3)
    start = momentum(world, pose, twist)[2]
    now = momentum(world, trajectory.pose[-1], trajectory.twist[-1])[2]
    assert abs(now - start) < 1e-3 * abs(start)


@pytest.mark.parametrize("twist", [(0.0, 0.0, 0.65), (0.1, -0.2, 0.0), (0.3, 0.1, 2.0)])
def test_a_kick_against_a_pin_moves_nothing(twist):
    """What a pin takes up of a velocity at once does not turn the body before.

    The noise of the motion is such kicks: else a pinned body's angle would have noise
    of its own, of half a step times whatever spin the pin takes up.
    """
    world = pendulum()
    pose, _ = swung(0.4)
    arm = pose[0, :2] - PIVOT
    mass, inertia = world.mass[0], world.inertia[0]
    moment = mass * (arm[0] * twist[1] - arm[1] * twist[0]) + inertia * twist[2]
    spin = moment / (mass * ARM**2 + inertia)
    kicked = run(world, pose, np.array([twist]), dt=0.02, num_steps=CHUNK)
    held = run(world, *swung(0.4, spin), dt=0.02, num_steps=CHUNK)
    np.testing.assert_allclose(kicked.pose[0], held.pose[0], atol=2e-6)
    np.testing.assert_allclose(kicked.twist[0], held.twist[0], atol=2e-5)
