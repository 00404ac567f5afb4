r"""One step of the world, and many: the public face of the engine.

A substep of length h, for every body at once:

1. turn half-way with the present spin; express twists in the frame found there;
2. solve for the new twists: forces, friction and joint impulses at mid-step, joints
   holding at the end (`velocity_solve`);
3. move with the mean of old and new twist;
4. put joint drift right, in position and in velocity, weighted by mass.

Second order for smooth motion; a single contact's viscous decay, its response to a
constant force and dry sliding in a straight line are exact. Where a contact changes
between sticking and slipping the order is one.

Derivatives exist everywhere and are finite, in both modes. They mean nothing at the
instant at which a contact starts or ceases to slip (a kink), and tell only of sticking
where everything sticks: there the motion does not depend on the dry limits at all.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.holding import hold, runtime_one
from boomdp_jax.physics.joints import (
    Frames,
    joint_rows,
)
from boomdp_jax.physics.lone_body import LoneBody
from boomdp_jax.physics.lone_step import lone_step
from boomdp_jax.physics.motion import Motion, motion_of, scalars, state_of
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.prepare import Prepared, prepare
from boomdp_jax.physics.projection import compliance_of, project
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State
from boomdp_jax.physics.trigonometry import sincos
from boomdp_jax.physics.velocity_solve import VelocityProblem, solve_velocity


class StepInfo(eqx.Module):
    """What a step reports and nobody needs to carry."""

    constraint_error: Float[Array, "*batch"]
    """Largest distance by which an active joint fails to hold after the step [m]."""
    is_finite: Bool[Array, "*batch"]
    cache: Any = None
    """What a solver may reuse in the next step; nothing is needed without contact."""


def step(
    scene: Scene,
    params: Params,
    state: State,
    wrench: Float[Array, "body 3"],
    *,
    dt: Float[Array, ""] | float | None = None,
    cache: Any = None,
) -> tuple[State, StepInfo]:
    """Advance a world by one step.

    Args:
        scene: outlines, feet, gravity.
        params: one hypothesis about everything that is not seen.
        state: poses and twists.
        wrench: forces and torques at the centres of mass, world frame, constant over
            the step [N, N, N m].
        dt: length of the step [s]; default: the scene's.
        cache: `StepInfo.cache` of the step before; may be left out.

    Returns:
        The next state, and what there is to report.
    """
    del cache  # No solver of this engine needs one without contact.
    length = jnp.asarray(scene.dt if dt is None else dt, state.pose.dtype)
    prepared = prepare(scene, params, length)
    motion, info = _step(scene, prepared, motion_of(state), wrench)
    return state_of(motion, scene.num_bodies), info


def prepare_step(
    scene: Scene, params: Params, *, dt: Float[Array, ""] | float | None = None
) -> Callable[[State, Float[Array, "body 3"]], tuple[State, StepInfo]]:
    """Work out all that does not depend on the state, for many steps from it.

    Inside a loop of one's own (a filter, a controller) a step then costs what one of
    `rollout` costs.

    Args:
        scene: outlines, feet, gravity.
        params: one hypothesis.
        dt: length of the step [s]; default: the scene's.

    Returns:
        A function from state and wrench `[body, 3]` to the next state and what there
        is to report; the same as `step`.
    """
    length = jnp.asarray(scene.dt if dt is None else dt, scene.area.dtype)
    prepared = prepare(scene, params, length)

    def advance(state: State, wrench: Float[Array, "body 3"]) -> tuple[State, StepInfo]:
        motion, info = _step(scene, prepared, motion_of(state), wrench)
        return state_of(motion, scene.num_bodies), info

    return advance


def rollout(
    scene: Scene,
    params: Params,
    state: State,
    wrenches: Float[Array, "time body 3"],
    *,
    dt: Float[Array, " time"] | Float[Array, ""] | float | None = None,
) -> tuple[State, StepInfo]:
    """Advance a world by many steps in one compiled loop.

    Under `vmap` on a CPU a batch of a multiple of 1,024 (float32) is up to a fifth
    slower than one of a few more or less: its arrays compete for the same cache lines.

    Args:
        scene: outlines, feet, gravity.
        params: one hypothesis.
        state: where it starts.
        wrenches: one per step and body, world frame [N, N, N m].
        dt: length of the steps [s], one for all or one for each; default: the scene's.

    Returns:
        The states after each step and their reports, with a leading time axis.
    """
    length = jnp.asarray(scene.dt if dt is None else dt, state.pose.dtype)
    constant = prepare(scene, params, length) if length.ndim == 0 else None

    def advance(motion, inputs):
        wrench, step_length = inputs
        prepared = prepare(scene, params, step_length) if constant is None else constant
        motion, info = _step(scene, prepared, motion, wrench)
        return motion, (state_of(motion, scene.num_bodies), info)

    inputs = (wrenches, length if constant is None else None)
    # A reverse pass takes every step again from the state before it: cheaper than to
    # store the hundred numbers of each substep, and long rollouts fit into memory. A
    # lone body's does so of itself (`core.one_loop`).
    is_lone = isinstance(constant, LoneBody)
    one_step = advance if is_lone else jax.checkpoint(advance, prevent_cse=False)
    return jax.lax.scan(one_step, motion_of(state), inputs)[1]


def _step(
    scene: Scene, prepared: Prepared | LoneBody, motion: Motion, wrench
) -> tuple[Motion, StepInfo]:
    """All substeps of one step."""
    force = scalars(wrench)
    if isinstance(prepared, LoneBody):
        motion, error, is_finite = lone_step(
            prepared, motion, force, scene.num_substeps
        )
        return motion, StepInfo(constraint_error=error, is_finite=is_finite)
    if scene.num_substeps == 1:
        motion = _substep(prepared, motion, force)
        return motion, _info(prepared, motion)
    motion, _ = jax.lax.scan(
        lambda m, _: (_substep(prepared, m, force), None),
        motion,
        None,
        length=scene.num_substeps,
    )
    return motion, _info(prepared, motion)


def _substep(prepared: Prepared, motion: Motion, force) -> Motion:
    h, mobile = prepared.length, prepared.mobile
    mass, inertia = prepared.mass, prepared.inertia
    vx, vy, spin = (mobile * v for v in motion[3:])
    one = runtime_one(mass)

    def held(values):
        return jax.tree.map(lambda v: hold(v, one), values)

    half_turn = 0.5 * h * spin
    sin, cos = held(sincos(motion.theta + half_turn))
    start = held((cos * vx + sin * vy, cos * vy - sin * vx, spin))
    push_x = mobile * (h * force[0] + prepared.weight[0])
    push_y = mobile * (h * force[1] + prepared.weight[1])
    momentum = held(
        (
            mass * start[0] + cos * push_x + sin * push_y,
            mass * start[1] + cos * push_y - sin * push_x,
            inertia * spin + mobile * h * force[2],
        )
    )
    sin_half, cos_half = held(sincos(half_turn))
    rows_mid, rows_end, compliance = [], [], []
    if prepared.slots:
        middle = Frames(motion.x + 0.5 * h * vx, motion.y + 0.5 * h * vy, cos, sin)
        end = Frames(
            motion.x + h * vx, motion.y + h * vy, cos, sin, (cos_half, sin_half)
        )
        rows_mid = joint_rows(prepared.slots, middle)
        rows_end = joint_rows(prepared.slots, end)
        compliance = compliance_of(prepared, rows_mid)
    solution = solve_velocity(
        VelocityProblem(
            mass=mass,
            inertia=inertia,
            momentum=momentum,
            start=start,
            turn=(cos_half, sin_half),
            contacts=prepared.contacts,
            spins=prepared.spins,
            rows_mid=rows_mid,
            rows_end=rows_end,
            compliance=compliance,
            joint_spins=prepared.joint_spins,
        )
    )
    wx, wy, new_spin = held(solution.twist)
    new_vx, new_vy = cos * wx - sin * wy, sin * wx + cos * wy
    moved = held(
        Motion(
            motion.x + 0.5 * h * (vx + new_vx),
            motion.y + 0.5 * h * (vy + new_vy),
            motion.theta + 0.5 * h * (spin + new_spin),
            new_vx,
            new_vy,
            new_spin,
        )
    )
    if not prepared.slots:
        return moved
    return project(prepared, moved)


def _info(prepared: Prepared, motion: Motion) -> StepInfo:
    """Joint drift and finiteness of a motion."""
    square = jnp.zeros((), motion.x.dtype)
    if prepared.slots:
        sin, cos = sincos(motion.theta)
        frames = Frames(motion.x, motion.y, cos, sin)
        for slot in prepared.slots:
            drift = sum(row.error**2 for row in joint_rows([slot], frames))
            square = jnp.maximum(square, drift)
    has_error = square > 0
    error = jnp.where(has_error, jnp.sqrt(jnp.where(has_error, square, 1.0)), 0.0)
    total = jnp.sum(sum(motion))
    return StepInfo(constraint_error=error, is_finite=jnp.isfinite(total))
