r"""A grasp is a weld, written as data, that is lost before it would bear too much.

What a grasp bears is told by the robot's momentum, whoever the robot is. With its
bodies i, what they are driven with $(F_i, \tau_i)$, what contacts do to them
$(C_i, \kappa_i)$, and gravity, the rest is the reaction R at the grasp's point g:

$$R = \sum_i R_i, \quad R_i = m_i (\Delta v_i / h - \gamma) - F_i - C_i, \qquad
  \tau_R = \sum_i I_i \Delta \omega_i / h - \tau_i - \kappa_i + (x_i - g) \times R_i,$$

with positions at mid-step; motors and joints between the bodies cancel. A step in which
that would exceed the limits is taken without the grasp, which is lost as it begins: no
step's mean reaction is ever beyond the limits.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, IntScalar
from boomdp_jax.physics.params import Params, Weld
from boomdp_jax.physics.quantities import mass_and_inertia
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State
from boomdp_jax.physics.step import StepInfo, step


class Holder(NamedTuple):
    """Whose momentum tells what a grasp bears."""

    bodies: Int[Array, " own"]
    """Indices of all that the robot is made of."""
    grip_of: Callable[[Float[Array, "own 3"]], Float[Array, "2"]]
    """From poses of these to the point of the grasp [m]."""


class Stepped(NamedTuple):
    """What came of a step."""

    params: Params
    """The slot inactive if the grasp gave way."""
    after: State
    info: StepInfo
    reaction: Float[Array, "3"]
    """Of the grasp on the robot about the grasp's point, world frame, mean over the
    step [N, N, N m]; zero if nothing was held throughout."""
    has_slipped: BoolScalar


def grasp_slot(params: Params) -> Weld:
    """All welds of a scene; the grasp is the last.

    Args:
        params: one hypothesis.

    Raises:
        ValueError: no weld at all.
    """
    if params.weld is None:
        raise ValueError(
            "params: weld: expected a slot for the grasp (ArmScene.params), got None"
        )
    return params.weld


def with_grasp(
    params: Params,
    is_active: BoolScalar,
    *,
    hand: IntScalar,
    held: IntScalar,
    on_hand: Float[Array, "2"],
    on_held: Float[Array, "2"],
    angle: FloatScalar,
) -> Params:
    """Write the grasp's slot.

    Args:
        params: one hypothesis.
        is_active: whether it holds.
        hand: index of the robot's body that holds.
        held: index of what is held.
        on_hand: the grasp's point, frame of the hand [m].
        on_held: the same point, frame of what is held [m].
        angle: of the hand against what is held [rad].

    Returns:
        The params with that slot.
    """
    weld = grasp_slot(params)
    slot = {
        "active": is_active,
        "body_a": hand,
        "body_b": held,
        "anchor_a": on_hand,
        "anchor_b": on_held,
        "angle": angle,
    }

    def written(field: str) -> Array:
        column = getattr(weld, field)
        return column.at[-1].set(slot[field].astype(column.dtype))

    return dataclasses.replace(
        params, weld=Weld(**{field: written(field) for field in slot})
    )


def with_active(params: Params, is_active: BoolScalar) -> Params:
    """The grasp as it was, holding or not."""
    weld = grasp_slot(params)
    active = weld.active.at[-1].set(is_active)
    return dataclasses.replace(params, weld=dataclasses.replace(weld, active=active))


def yielding_step(
    robot: Holder,
    scene: Scene,
    params: Params,
    state: State,
    wrench: Float[Array, "body 3"],
    limit: Float[Array, "2"],
) -> Stepped:
    """One step of the world in which a grasp is lost rather than bear too much.

    Costs two steps where it is lost. There is no derivative in reverse mode.

    Args:
        robot: who holds.
        scene: outlines.
        params: one hypothesis; what is commanded acts (no `actuator`).
        state: where all is.
        wrench: on all bodies, world frame [N, N, N m].
        limit: largest force [N] and torque [N m] of the grasp; infinite for none.

    Returns:
        What came of it.
    """
    was_held = grasp_slot(params).active[-1]

    def attempt(params: Params) -> tuple:
        after, info = step(scene, params, state, wrench)
        return (
            after,
            info,
            _reaction(robot, scene, params, (state, after), wrench, info),
        )

    def goes_on(carry: tuple) -> BoolScalar:
        count, params, (_, _, felt) = carry
        bears = jnp.stack([jnp.hypot(felt[0], felt[1]), jnp.abs(felt[2])])
        is_too_much = grasp_slot(params).active[-1] & jnp.any(bears > limit)
        return (count == 0) | is_too_much

    def again(carry: tuple) -> tuple:
        count, params, _ = carry
        params = with_active(params, grasp_slot(params).active[-1] & (count == 0))
        return count + 1, params, attempt(params)

    # A loop, so that the step is compiled once.
    blank = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(attempt, params)
    )
    _, params, (after, info, felt) = jax.lax.while_loop(
        goes_on, again, (0, params, blank)
    )
    is_held = grasp_slot(params).active[-1]
    return Stepped(
        params, after, info, jnp.where(is_held, felt, 0.0), was_held & ~is_held
    )


def _reaction(
    robot: Holder,
    scene: Scene,
    params: Params,
    states: tuple[State, State],
    wrench: Float[Array, "body 3"],
    info: StepInfo,
) -> Float[Array, "3"]:
    """Of the grasp on the robot, by its balance of momentum."""
    bodies = robot.bodies
    mass, inertia = (part[bodies] for part in mass_and_inertia(scene, params))
    before, after = (state.pose[bodies] for state in states)
    change = (states[1].twist[bodies] - states[0].twist[bodies]) / scene.dt
    given = wrench[bodies]
    if info.contact_wrench is not None:
        given = given + info.contact_wrench[bodies]
    push = mass[:, None] * (change[:, :2] - scene.gravity[None]) - given[:, :2]
    grip = 0.5 * (robot.grip_of(before) + robot.grip_of(after))
    arm = 0.5 * (before[:, :2] + after[:, :2]) - grip[None]
    turn = inertia * change[:, 2] - given[:, 2]
    turn = turn + arm[:, 0] * push[:, 1] - arm[:, 1] * push[:, 0]
    return jnp.append(jnp.sum(push, axis=0), jnp.sum(turn))
