"""Which of MuJoCo's integrators a document names."""

from collections.abc import Iterator
from typing import Literal

import numpy as np
from jaxtyping import Float

from boomdp_jax.interop.mjcf_elements import is_coulomb, turned
from boomdp_jax.physics.friction import KNEE_SPEED
from boomdp_jax.physics.params import WORLD, Params, Prismatic, Revolute
from boomdp_jax.physics.scene_arrays import has_contact
from boomdp_jax.physics.scene_spec import SceneSpec

Integrator = Literal["implicitfast", "implicit", "Euler", "RK4"]

# Rate at which viscous forces slow anything down, over that of time steps, up to which
# Runge and Kutta's method follows them well; it is stable up to 2.8.
_MOST_RATE = 1.0


def usual_integrator(spec: SceneSpec, params: Params, time_step: float) -> Integrator:
    """One that follows a hypothesis and that MJX has as well.

    At 2 ms the paths of pendulums, chains, carts and closed loops are within 1e-6 m or
    rad of ours after a second by "RK4" and within 1e-2 by the others, which take the
    velocity after a step for that during it. Where bodies hit each other or a stop all
    are as good, and "implicitfast" costs a quarter.

    Args:
        spec: the scene.
        params: one hypothesis, of NumPy arrays.
        time_step: MuJoCo's own [s].
    """
    can_touch = params.surface is not None and has_contact(spec.bodies)
    if can_touch and not np.any(params.wheel.active):
        return "implicitfast"
    is_soft = largest_rate(spec, params) * time_step <= _MOST_RATE
    return "RK4" if is_soft else "implicitfast"


def largest_rate(spec: SceneSpec, params: Params) -> float:
    r"""Rate at which viscous forces slow down what they slow down most.

    Forces $-\sum_i c_i J_i^T J_i v$ on free bodies of mass matrix $M$ do so at the
    largest eigenvalue of $M^{-1/2} \sum_i c_i J_i^T J_i M^{-1/2}$; joints that hold
    bodies together only make it smaller.

    Args:
        spec: the scene.
        params: one hypothesis, of NumPy arrays.

    Returns:
        The rate [1/s].
    """
    mass = params.density * np.array([body.area for body in spec.bodies])
    gyration = np.array([body.gyration for body in spec.bodies])
    masses = np.stack([mass, mass, mass * gyration], axis=1)
    root = np.sqrt(np.where(spec.is_static[:, None], np.inf, masses))
    rows = [np.zeros((spec.num_bodies, 3))]
    rows += [np.sqrt(c) * jacobian for c, jacobian in _brakes(spec, params)]
    scaled = (np.stack(rows) / root).reshape(len(rows), -1)
    return float(np.linalg.norm(scaled, 2)) ** 2


def _brakes(
    spec: SceneSpec, params: Params
) -> Iterator[tuple[float, Float[np.ndarray, "body 3"]]]:
    """Coefficient and velocity, as a row over twists, of each viscous force."""
    num = spec.num_bodies
    center = np.zeros((num, 2))
    if params.center_of_mass is not None:
        center = np.asarray(params.center_of_mass)
    for slots in (params.revolute, params.prismatic):
        if slots is None:
            continue
        for slot in np.flatnonzero(slots.active):
            row = _joint_row(slots, int(slot), center)
            viscous, dry = float(slots.viscous[slot]), float(slots.dry[slot])
            # Dry friction alone is left to MuJoCo's solver.
            if viscous > 0.0 and dry > 0.0 and not is_coulomb(viscous, dry):
                yield viscous, row
            if slots.motor is not None and slots.motor[slot, 1] > 0.0:
                yield float(slots.motor[slot, 1]) / KNEE_SPEED, row
    wheel, ground = params.wheel, params.ground
    for body, slot in np.argwhere(wheel.active):
        arm = wheel.position[body, slot] - center[body]
        half = 0.0 if wheel.half_track is None else float(wheel.half_track[body, slot])
        for i, turn in enumerate((0.0, 0.5 * np.pi)):
            if wheel.dry[body, slot, i] > 0.0:
                angle = float(wheel.heading[body, slot]) + turn
                row = np.zeros((num, 3))
                row[body] = _along(turned(np.array([1.0, 0.0]), angle), arm)
                yield float(wheel.viscous[body, slot, i]), row
                # The two wheels of an axle turn the body as well, where they roll.
                spin = np.zeros((num, 3))
                spin[body, 2] = half if i == 0 else 0.0
                yield float(wheel.viscous[body, slot, i]), spin
    for body, slot in np.argwhere(ground.active):
        owner = spec.bodies[body]
        square = float(
            owner.foot_load @ (np.sum(owner.feet**2, 1) + owner.foot_size**2)
        )
        for i, scale in enumerate((1.0, 1.0, np.sqrt(square))):
            row = np.zeros((num, 3))
            row[body, i] = scale
            yield float(ground.viscous[body, slot]), row


def _joint_row(
    slots: Revolute | Prismatic, slot: int, center: Float[np.ndarray, "body 2"]
) -> Float[np.ndarray, "body 3"]:
    """How fast a joint moves, as it does where a drawer is shut."""
    row = np.zeros((len(center), 3))
    turns = isinstance(slots, Revolute)
    for body, anchor, sign in (
        (int(slots.body_a[slot]), slots.anchor_a[slot], 1.0),
        (int(slots.body_b[slot]), slots.anchor_b[slot], -1.0),
    ):
        if body == WORLD:
            continue
        if turns:
            row[body, 2] = sign
            continue
        # In the frame of `b`.
        angle = float(slots.angle[slot]) if sign > 0.0 else 0.0
        arm = turned(anchor - center[body], angle)
        line = turned(np.array([1.0, 0.0]), float(slots.axis[slot]))
        row[body] = sign * _along(line, arm)
    return row


def _along(
    line: Float[np.ndarray, "2"], arm: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "3"]:
    """Speed along a line of a point of a body, as a row over its twist."""
    return np.array([*line, arm[0] * line[1] - arm[1] * line[0]])
