r"""One step of the world, and many: the public face of the engine.

A substep of length h, for every body at once:

1. turn half-way with the present spin; express friction in the frame found there;
2. solve for the new twists: forces, friction and joint impulses at mid-step, joints
   holding at the end (`velocity_solve`);
3. move with the mean of old and new twist;
4. put joint drift right, in position and in velocity, weighted by mass (`projection`).

Substeps that turn bodies too far, linkages close to a dead centre and impacts with
friction can come out with more energy than they had; what nothing brought is taken away
again (`energy_limit`, `contact_energy`).

Second order for smooth motion; a single contact's viscous decay, its response to a
constant force and dry sliding in a straight line are exact. Where a contact changes
between sticking and slipping the order is one.

A scene with contact (`Scene.collides`) goes the same way substep by substep, with the
impulses of contacts in between (`contact_step`, `contact_coupling`). Bodies that touch
move with their new twist alone, an order lower. Bodies faster than the room between
two walls per substep may pass through; a body of 2 cm at 200 m/s is stopped by a wall
of 2 cm at 60 Hz. Where outlines overlap at the start they are moved apart at no more
than `contact_impulses.PUSH_SPEED`, which is not left in their twists.

Derivatives exist everywhere and are finite, in both modes. Where the motion is smooth
they are those of what is computed: of the instant of an impact as of its strength. They
mean nothing

- at the instant at which a contact starts or ceases to slip, or two outlines to touch
  (a kink; a jump in the twist if they bounce);
- where the nearest features change, from an edge to a corner (a jump of the normal);
- beyond some collisions, where trajectories of neighbours have nothing in common any
  more, however right each derivative is;

and they tell only of sticking where everything sticks: there the motion does not depend
on the dry limits at all.

They are zero where bodies do not touch, whatever a little more force would do. With
`Scene.smoothing`, a speed, bodies push a little before they touch and friction gives
way a little before its limit; derivatives then tell an optimiser which way contact
lies, and are those of a world that differs the less from the sharp one the smaller that
speed is. Twice the speed of a resting contact's fall in a substep (0.1 m/s under
gravity) is much, a tenth of it little. Restitution keeps its jump.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
from jax.tree_util import Partial
from jaxtyping import Array, Float

from boomdp_jax.physics.actuator import applied, without_actuator
from boomdp_jax.physics.arguments import (
    check_world,
    checked_length,
    checked_state,
    checked_step_length,
    checked_wrench,
    checked_wrenches,
)
from boomdp_jax.physics.center_of_mass import (
    about_center,
    state_of_center,
    state_of_reference,
    wrench_at_center,
)
from boomdp_jax.physics.lone_body import LoneBody
from boomdp_jax.physics.lone_rail import Rail, after_step, before_step
from boomdp_jax.physics.lone_step import lone_step
from boomdp_jax.physics.motion import Motion, motion_of, scalars, state_of
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.prepare import is_lone, prepare_lone
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State
from boomdp_jax.physics.step_info import StepInfo as StepInfo
from boomdp_jax.physics.world_rollout import (
    empty_cache,
    prepare_step_of_world,
    world_rollout,
    world_step,
)


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
        wrench: forces and torques at the reference points of the states, which are the
            centres of mass unless `Params.center_of_mass` says otherwise; world frame,
            constant over the step [N, N, N m]. Gain and bias of `Params.actuator` are
            applied to them, its delay has to be before (`delayed_wrenches`).
        dt: length of the step [s]; default: the scene's.
        cache: `StepInfo.cache` of the step before; may be left out.

    Returns:
        The next state, and what there is to report.

    Raises:
        TypeError: a scene, params or a state that is none.
        ValueError: params of another number of bodies or a batch of them, a state or a
            wrench of another shape, a length that is no single number or below zero.
    """
    check_world(scene, params)
    state = checked_state(scene.num_bodies, state)
    wrench = checked_wrench(scene.num_bodies, wrench)
    length = checked_step_length(scene.dt if dt is None else dt, state.pose.dtype)
    return _stepped(scene, params, length, state, wrench, cache)


# Inlined wherever it is traced; by itself it is compiled once, and not its loops anew
# at every call.
@functools.partial(jax.jit, inline=True)
def _stepped(
    scene: Scene, params: Params, length: Array, state: State, wrench: Array, cache: Any
) -> tuple[State, StepInfo]:
    return _step_of(scene, params, length)(state, wrench, cache)


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
        is to report; the same as `step`. It is a pytree of what was worked out, so
        that it may be batched by `vmap` and given to compiled functions.

    Raises:
        TypeError: a scene or params that are none.
        ValueError: params of another number of bodies or a batch of them, a length that
            is no single number or below zero.
    """
    check_world(scene, params)
    length = checked_step_length(scene.dt if dt is None else dt, scene.area.dtype)
    return Partial(_without_cache, _step_of(scene, params, length))


@functools.partial(jax.jit, inline=True)
def _without_cache(advance: Callable, state: State, wrench: Array) -> tuple:
    return advance(state, wrench, None)


def next_motion(prepared: Callable, motion: Motion, wrench: Array) -> Motion:
    """What `prepare_step` returns, applied to a lone body number by number.

    In a loop over steps whose carries are numbers this saves to put them together into
    arrays for each step and to take those apart: a twentieth of a filter's time.

    Args:
        prepared: by `prepare_step`, of a scene of one body.
        motion: before.
        wrench: `[1, 3]`, as for `step` [N, N, N m].

    Returns:
        The motion after the step.
    """
    assert isinstance(prepared, Partial)
    advance = prepared.args[0] if prepared.func is _without_cache else prepared
    if advance.func is _lone_step:
        return _lone(*advance.args, motion, wrench)[0]
    if advance.func is _step_applied:
        within, scene, params = advance.args
        return next_motion(within, motion, applied(params, wrench, scene.is_static))
    return motion_of(advance(state_of(motion, 1), wrench, None)[0])


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
    With `out_axes=1` time stays in front, and nothing has to be turned round at the
    end: 4,096 lone bodies then take a third less.

    Args:
        scene: outlines, feet, gravity.
        params: one hypothesis.
        state: where it starts.
        wrenches: one per step and body, world frame [N, N, N m].
        dt: length of the steps [s], one for all or one for each; default: the scene's.

    Returns:
        The states after each step and their reports, with a leading time axis.

    Raises:
        TypeError: a scene, params or a state that is none.
        ValueError: params of another number of bodies or a batch of them, a state,
            wrenches or lengths of another shape.
    """
    check_world(scene, params)
    state = checked_state(scene.num_bodies, state)
    wrenches = checked_wrenches(scene.num_bodies, wrenches)
    length = checked_length(
        scene.dt if dt is None else dt, wrenches.shape[0], state.pose.dtype
    )
    return _rolled_out(scene, params, state, wrenches, length)


@functools.partial(jax.jit, inline=True)
def _rolled_out(
    scene: Scene, params: Params, state: State, wrenches: Array, length: Array
) -> tuple[State, StepInfo]:
    if params.actuator is not None:
        wrenches = jax.vmap(lambda wrench: applied(params, wrench, scene.is_static))(
            wrenches
        )
        return _rolled_out(scene, without_actuator(params), state, wrenches, length)
    if params.center_of_mass is not None:
        return _rollout_of_reference(scene, params, state, wrenches, length)
    if not is_lone(scene, params):
        return world_rollout(scene, params, state, wrenches, length)
    constant = prepare_lone(scene, params, length) if length.ndim == 0 else None

    def advance(motion, inputs):
        wrench, now = inputs
        body = prepare_lone(scene, params, now) if constant is None else constant
        motion, info = _lone(scene, body, motion, wrench)
        return motion, (state_of(motion, scene.num_bodies), info)

    inputs = (wrenches, length if constant is None else None)
    # A reverse pass takes every step again from the state before it: cheaper than to
    # store the hundred numbers of each substep, and long rollouts fit into memory. A
    # lone body's does so of itself (`core.one_loop`), but for what depends on length.
    one_step = advance
    if constant is None:
        one_step = jax.checkpoint(advance, prevent_cse=False)
    return jax.lax.scan(one_step, motion_of(state), inputs)[1]


def _rollout_of_reference(
    scene: Scene, params: Params, state: State, wrenches: Array, length: Array
) -> tuple[State, StepInfo]:
    """The same where centres of mass are elsewhere: torques depend on the pose."""
    constant = _step_of(scene, params, length) if length.ndim == 0 else None

    def advance(carry, inputs):
        wrench, now = inputs
        one_step = _step_of(scene, params, now) if constant is None else constant
        state, info = one_step(carry[0], wrench, carry[1])
        report = dataclasses.replace(info, cache=None)
        return (state, info.cache), (state, report)

    inputs = (wrenches, length if constant is None else None)
    one_step = jax.checkpoint(advance, prevent_cse=False)
    return jax.lax.scan(one_step, (state, empty_cache(scene)), inputs)[1]


def _step_of(scene: Scene, params: Params, length: Array) -> Partial:
    """A function from state, wrench and cache, with what is constant worked out."""
    if params.actuator is not None:
        advance = _step_of(scene, without_actuator(params), length)
        return Partial(_step_applied, advance, scene, params)
    if params.center_of_mass is not None:
        advance = _step_of(*about_center(scene, params), length)
        return Partial(_step_of_reference, advance, params, length)
    if not is_lone(scene, params):
        return Partial(world_step, scene, prepare_step_of_world(scene, params, length))
    return Partial(_lone_step, scene, prepare_lone(scene, params, length))


def _step_applied(
    advance: Callable, scene: Scene, params: Params, state: State, wrench, cache: Any
) -> tuple[State, StepInfo]:
    return advance(state, applied(params, wrench, scene.is_static), cache)


def _step_of_reference(
    advance: Callable, params: Params, length: Array, state: State, wrench, cache: Any
) -> tuple[State, StepInfo]:
    wrench = wrench_at_center(params, state, wrench, length)
    center, info = advance(state_of_center(params, state), wrench, cache)
    return state_of_reference(params, center), info


def _lone_step(
    scene: Scene, held: tuple, state: State, wrench, cache: Any
) -> tuple[State, StepInfo]:
    del cache
    motion, info = _lone(scene, held, motion_of(state), wrench)
    return state_of(motion, scene.num_bodies), info


def _lone(
    scene: Scene, held: tuple[LoneBody, Rail | None], motion: Motion, wrench
) -> tuple[Motion, StepInfo]:
    """All substeps of one step."""
    body, rail = held
    motion, force = before_step(rail, motion, scalars(wrench))
    motion, error, is_finite = lone_step(body, motion, force, scene.num_substeps)
    motion = after_step(rail, motion)
    return motion, StepInfo(constraint_error=error, is_finite=is_finite)
