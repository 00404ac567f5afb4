r"""A centre of mass that is not where a body's pose is: seen from the one or the other.

The engine knows bodies by their centre of mass. Where `Params.center_of_mass` says that
it lies at c in the frame in which states, wrenches, outlines, anchors and wheels are
given, with R the body's rotation, x its reference point and ω its spin,

$$x_c = x + R c, \qquad v_c = v + \omega \times R c, \qquad
  \tau_c = \tau - R c \times f.$$

Mass and inertia about the centre of mass are those of the outline, as they are where a
scene gives a centre of mass. The floor carries a body under its centre of mass.
"""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.physics.params import WORLD, Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State


def about_center(scene: Scene, params: Params) -> tuple[Scene, Params]:
    """Scene and hypothesis in frames whose origins are the centres of mass.

    A circle's outline stays where the centre of mass is: scenes in which one touches
    others must know its centre.

    Args:
        scene: outlines and feet.
        params: one hypothesis.

    Returns:
        Both, themselves where no centre of mass is elsewhere.
    """
    center = params.center_of_mass
    if center is None:
        return scene, params
    scene = dataclasses.replace(
        scene,
        vertices=scene.vertices - center[:, None],
    )
    changes: dict = {"center_of_mass": None}
    for kind in ("revolute", "distance", "prismatic", "weld"):
        joints = getattr(params, kind)
        if joints is None:
            continue
        is_world = (joints.body_b == WORLD)[:, None]
        of_b = jnp.where(is_world, 0.0, center[jnp.maximum(joints.body_b, 0)])
        changes[kind] = dataclasses.replace(
            joints,
            anchor_a=joints.anchor_a - center[joints.body_a],
            anchor_b=joints.anchor_b - of_b,
        )
    wheel = params.wheel
    changes["wheel"] = dataclasses.replace(
        wheel, position=wheel.position - center[:, None]
    )
    # A body stands under its centre of mass as its feet do about the reference point.
    return scene, dataclasses.replace(params, **changes)


def state_of_center(params: Params, state: State) -> State:
    """Poses and twists of the centres of mass.

    Args:
        params: one hypothesis.
        state: of the reference points.

    Returns:
        The same bodies, itself where no centre of mass is elsewhere.
    """
    if params.center_of_mass is None:
        return state
    return _moved(params.center_of_mass, state)


def state_of_reference(params: Params, state: State) -> State:
    """The inverse of `state_of_center`."""
    if params.center_of_mass is None:
        return state
    return _moved(-params.center_of_mass, state)


def wrench_at_center(
    params: Params,
    state: State,
    wrench: Float[Array, "body 3"],
    length: FloatScalar | float,
) -> Float[Array, "body 3"]:
    """A wrench at the reference points as one at the centres of mass.

    The force stays at its point of the body, which turns; the arm is that of half-way
    through the step at the present spin, so that the torque is right to second order.

    Args:
        params: one hypothesis.
        state: of the reference points, or of the centres of mass.
        wrench: at the reference points, world frame [N, N, N m].
        length: of the step [s].

    Returns:
        The wrench at the centres of mass.
    """
    if params.center_of_mass is None:
        return wrench
    angle = state.pose[:, 2] + 0.5 * length * state.twist[:, 2]
    arm = _turned(params.center_of_mass, angle)
    torque = wrench[:, 2] - (arm[:, 0] * wrench[:, 1] - arm[:, 1] * wrench[:, 0])
    return jnp.concatenate([wrench[:, :2], torque[:, None]], axis=-1)


def _moved(offset: Float[Array, "body 2"], state: State) -> State:
    """The state of points that lie so far away in the frames of their bodies."""
    angle, spin = state.pose[:, 2:], state.twist[:, 2:]
    arm = _turned(offset, state.pose[:, 2])
    across = jnp.stack([-arm[:, 1], arm[:, 0]], axis=-1)
    return State(
        pose=jnp.concatenate([state.pose[:, :2] + arm, angle], axis=-1),
        twist=jnp.concatenate([state.twist[:, :2] + spin * across, spin], axis=-1),
    )


def _turned(
    offset: Float[Array, "body 2"], angle: Float[Array, " body"]
) -> Float[Array, "body 2"]:
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack(
        [
            cos * offset[:, 0] - sin * offset[:, 1],
            sin * offset[:, 0] + cos * offset[:, 1],
        ],
        axis=-1,
    )
