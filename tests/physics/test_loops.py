"""Closed loops: four-bar linkages move with their one degree of freedom."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from boomdp_jax.physics import State, rollout, scene_spec_from_dict
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


def test_a_heavy_piston_drives_a_light_crank_through_dead_centre_for_nothing():
    """All energy is in the crank there, and more steps than there are would show it."""
    crank, rod, angle = 0.2, 0.5, 1.0
    reach = np.sqrt(rod**2 - (crank * np.sin(angle)) ** 2)
    tip = crank * np.array([np.cos(angle), np.sin(angle)])

    def box(name, half_extents, pose):
        shape = {"type": "box", "half_extents": half_extents}
        return {"name": name, "shape": shape, "pose": pose, "density": 20.0}

    def tie(kind, a, b, at_a, **more):
        return {"type": kind, "a": a, "b": b, "anchor_a": at_a, **more}

    origin = [0.0, 0.0]
    spec = scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": origin,
            "dt": 0.02,
            "bodies": [
                box("crank", [0.5 * crank, 0.01], [*(0.5 * tip), angle]),
                box("piston", [0.4, 0.3], [tip[0] + reach, 0.0, 0.0]),
            ],
            "constraints": [
                tie("revolute", "crank", "world", [-0.5 * crank, 0.0], anchor_b=origin),
                tie(
                    *("distance", "crank", "piston", [0.5 * crank, 0.0]),
                    anchor_b=origin,
                    length=rod,
                ),
                tie(
                    *("prismatic", "piston", "world", origin),
                    anchor_b=origin,
                    axis=0.0,
                    angle=0.0,
                ),
            ],
        }
    )
    spins = np.linspace(0.5, 20.0, 200)
    twist = np.zeros((200, 2, 3))
    twist[:, 0] = spins[:, None] * [-0.5 * tip[1], 0.5 * tip[0], 1.0]
    twist[:, 1, 0] = -spins * tip[1] * (1.0 + tip[0] / reach)
    scene, params = spec.scene, spec.params()
    mass = np.asarray(params.density * scene.area)
    inertia = mass * np.asarray(scene.gyration)

    def kinetic(twist):
        square = np.asarray(twist) ** 2
        linear = mass * (square[..., 0] + square[..., 1])
        return 0.5 * np.sum(linear + inertia * square[..., 2], axis=-1)

    pose = jnp.broadcast_to(spec.initial_state().pose, twist.shape)
    start = State(pose, jnp.asarray(twist))
    wrenches = jnp.zeros((200, 2, 3))
    states, _ = jax.jit(
        jax.vmap(lambda state: rollout(scene, params, state, wrenches))
    )(start)
    ratio = kinetic(states.twist) / kinetic(twist)[:, None]
    assert np.max(ratio) < 1.02
    assert np.all(np.isfinite(ratio))
