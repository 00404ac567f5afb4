"""Slow, plain NumPy dynamics of planar rigid bodies: what the engine is compared with.

Works on accelerations with Lagrange multipliers and leaves time to SciPy's adaptive
integrators at tight tolerances, so it shares neither code nor method with the engine.
"""

from dataclasses import dataclass, field, replace
from math import inf

import numpy as np
from scipy.integrate import solve_ivp

WORLD = -1


@dataclass(frozen=True)
class Pin:
    """An anchor of body `a` and one of `b` coincide."""

    a: int
    anchor_a: tuple[float, float]
    anchor_b: tuple[float, float]
    b: int = WORLD
    viscous: float = 0.0
    dry: float = inf


@dataclass(frozen=True)
class Rod:
    """An anchor of body `a` keeps its distance from one of `b`."""

    a: int
    anchor_a: tuple[float, float]
    anchor_b: tuple[float, float]
    length: float
    b: int = WORLD


@dataclass(frozen=True)
class Wheel:
    """Anisotropic friction; pairs are (rolling, lateral)."""

    body: int
    position: tuple[float, float]
    heading: float
    viscous: tuple[float, float]
    dry: tuple[float, float] = (inf, inf)


@dataclass(frozen=True)
class Ground:
    """Isotropic friction of all feet together."""

    body: int
    dry: float
    viscous: float


@dataclass(frozen=True)
class World:
    """Boxes of uniform density with four feet each, and what constrains them."""

    half_extents: list[tuple[float, float]]
    density: list[float]
    gravity: tuple[float, float] = (0.0, 0.0)
    normal_gravity: float = 9.81
    pins: list[Pin] = field(default_factory=list)
    rods: list[Rod] = field(default_factory=list)
    wheels: list[Wheel] = field(default_factory=list)
    grounds: list[Ground] = field(default_factory=list)

    @property
    def num_bodies(self) -> int:
        return len(self.density)

    @property
    def area(self) -> np.ndarray:
        return np.array([4.0 * hx * hy for hx, hy in self.half_extents])

    @property
    def gyration(self) -> np.ndarray:
        return np.array([(hx**2 + hy**2) / 3.0 for hx, hy in self.half_extents])

    @property
    def feet(self) -> np.ndarray:
        signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / np.sqrt(3.0)
        return np.array([signs * extents for extents in self.half_extents])

    @property
    def mass(self) -> np.ndarray:
        return np.array(self.density) * self.area

    @property
    def inertia(self) -> np.ndarray:
        return self.mass * self.gyration

    def with_(self, **changes) -> "World":
        return replace(self, **changes)


def rotation(angle: float) -> np.ndarray:
    """Matrix that turns a vector counter-clockwise."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def friction_force(velocity: np.ndarray, viscous: np.ndarray, dry: np.ndarray):
    """Viscous force scaled back along its direction onto the ellipse of dry limits."""
    force = -np.asarray(viscous) * velocity
    return force / max(1.0, float(np.linalg.norm(force / np.asarray(dry))))


def friction_wrench(world: World, pose: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """Sum of all friction on each body, `[body, 3]`."""
    total = np.zeros((world.num_bodies, 3))

    def push(body, local_point, local_angle, viscous, dry):
        arm = rotation(pose[body, 2]) @ np.asarray(local_point)
        velocity = twist[body, :2] + twist[body, 2] * np.array([-arm[1], arm[0]])
        frame = rotation(pose[body, 2] + local_angle)
        force = frame @ friction_force(frame.T @ velocity, viscous, dry)
        total[body] += [*force, arm[0] * force[1] - arm[1] * force[0]]

    for wheel in world.wheels:
        push(wheel.body, wheel.position, wheel.heading, wheel.viscous, wheel.dry)
    for ground in world.grounds:
        weight = world.mass[ground.body] * world.normal_gravity
        for foot in world.feet[ground.body]:
            limit = 0.25 * ground.dry * weight
            push(ground.body, foot, 0.0, [0.25 * ground.viscous] * 2, [limit] * 2)
    for pin in world.pins:
        spin = twist[pin.a, 2] - (0.0 if pin.b == WORLD else twist[pin.b, 2])
        torque = float(np.clip(-pin.viscous * spin, -pin.dry, pin.dry))
        total[pin.a, 2] += torque
        if pin.b != WORLD:
            total[pin.b, 2] -= torque
    return total


def anchor_gap(joint: Pin | Rod, pose: np.ndarray) -> np.ndarray:
    """Anchor of `a` minus anchor of `b`, world frame [m]."""
    gap = pose[joint.a, :2] + rotation(pose[joint.a, 2]) @ np.asarray(joint.anchor_a)
    if joint.b == WORLD:
        return gap - np.asarray(joint.anchor_b)
    other = rotation(pose[joint.b, 2]) @ np.asarray(joint.anchor_b)
    return gap - pose[joint.b, :2] - other


def drift(world: World, pose: np.ndarray) -> float:
    """Largest violation of any joint [m]."""
    pins = [np.linalg.norm(anchor_gap(pin, pose)) for pin in world.pins]
    rods = [
        abs(np.linalg.norm(anchor_gap(rod, pose)) - rod.length) for rod in world.rods
    ]
    return float(max(pins + rods, default=0.0))


def _joint_rows(world: World, pose: np.ndarray, twist: np.ndarray):
    """Rows J and right-hand sides b of J a = b, a the accelerations of all bodies."""
    rows, targets = [], []
    for joint in [*world.pins, *world.rods]:
        J, b = np.zeros((2, 3 * world.num_bodies)), np.zeros(2)
        ends = [(joint.a, joint.anchor_a, 1.0), (joint.b, joint.anchor_b, -1.0)]
        for body, anchor, sign in ends:
            if body == WORLD:
                continue
            arm = rotation(pose[body, 2]) @ np.asarray(anchor)
            J[:, 3 * body : 3 * body + 2] += sign * np.eye(2)
            J[:, 3 * body + 2] += sign * np.array([-arm[1], arm[0]])
            b += sign * twist[body, 2] ** 2 * arm
        if isinstance(joint, Rod):
            gap = anchor_gap(joint, pose)
            rate = J @ twist.ravel()
            J, b = (gap @ J)[None], np.array([gap @ b - rate @ rate])
        rows.append(J)
        targets.append(b)
    return np.concatenate(rows), np.concatenate(targets)


def acceleration(
    world: World, pose: np.ndarray, twist: np.ndarray, wrench: np.ndarray
) -> np.ndarray:
    """Accelerations of all bodies, `[body, 3]`, joints held by Lagrange multipliers."""
    inverse = np.stack([1 / world.mass, 1 / world.mass, 1 / world.inertia], axis=1)
    weight = world.mass[:, None] * np.array([*world.gravity, 0.0])
    force = wrench + weight + friction_wrench(world, pose, twist)
    free = (inverse * force).ravel()
    if not world.pins and not world.rods:
        return free.reshape(-1, 3)
    J, b = _joint_rows(world, pose, twist)
    scaled = inverse.ravel()[:, None] * J.T
    multiplier = np.linalg.lstsq(J @ scaled, b - J @ free, rcond=None)[0]
    return (free + scaled @ multiplier).reshape(-1, 3)


def integrate(
    world: World,
    pose: np.ndarray,
    twist: np.ndarray,
    times: np.ndarray,
    *,
    wrench: np.ndarray | None = None,
    method: str = "DOP853",
    rtol: float = 1e-10,
) -> tuple[np.ndarray, np.ndarray]:
    """Poses and twists at given times, under a constant wrench.

    Choose `method="Radau"` for stiff friction.
    """
    count = 3 * world.num_bodies
    wrench = np.zeros((world.num_bodies, 3)) if wrench is None else np.asarray(wrench)

    def rate(_, y):
        pose, twist = y[:count].reshape(-1, 3), y[count:].reshape(-1, 3)
        return np.concatenate(
            [y[count:], acceleration(world, pose, twist, wrench).ravel()]
        )

    start = np.concatenate([np.ravel(pose), np.ravel(twist)])
    solution = solve_ivp(
        rate,
        (0.0, float(times[-1])),
        start,
        t_eval=times,
        method=method,
        rtol=rtol,
        atol=1e-2 * rtol,
    )
    assert solution.success, solution.message
    y = solution.y.T
    return y[:, :count].reshape(-1, world.num_bodies, 3), y[:, count:].reshape(
        -1, world.num_bodies, 3
    )


def energy(world: World, pose: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """Kinetic plus potential energy of all bodies, for leading axes of time [J]."""
    mass, inertia = world.mass, world.inertia
    kinetic = 0.5 * mass * np.sum(twist[..., :2] ** 2, axis=-1)
    kinetic = kinetic + 0.5 * inertia * twist[..., 2] ** 2
    potential = -mass * (pose[..., :2] @ np.asarray(world.gravity))
    return np.sum(kinetic + potential, axis=-1)


def momentum(world: World, pose: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """Linear momentum and angular momentum about the origin, `[..., 3]`."""
    linear = world.mass[:, None] * twist[..., :2]
    spin = world.inertia * twist[..., 2]
    orbital = pose[..., 0] * linear[..., 1] - pose[..., 1] * linear[..., 0]
    return np.concatenate(
        [linear.sum(axis=-2), (spin + orbital).sum(axis=-1)[..., None]], axis=-1
    )
