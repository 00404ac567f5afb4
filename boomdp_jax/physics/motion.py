"""A state in scalars, which is what fuses and vectorises."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.physics.state import State


class Motion(NamedTuple):
    """Poses and twists: one array over bodies for each number.

    A scene of one body has no body axis here: a trailing axis of length one would keep
    the loops over hypotheses from vectorising.
    """

    x: Float[Array, "*body"]
    y: Float[Array, "*body"]
    theta: Float[Array, "*body"]
    vx: Float[Array, "*body"]
    vy: Float[Array, "*body"]
    spin: Float[Array, "*body"]


def scalars(array: Float[Array, "body k"]) -> tuple[Float[Array, "*body"], ...]:
    """Columns of an array over bodies; without the body axis where there is one."""
    array = array[0] if array.shape[0] == 1 else array
    return tuple(array[..., i] for i in range(array.shape[-1]))


def motion_of(state: State) -> Motion:
    """Take a state apart."""
    return Motion(*scalars(state.pose), *scalars(state.twist))


def state_of(motion: Motion, num_bodies: int) -> State:
    """Put a state together; leading axes (time) stay in front."""
    pose, twist = jnp.stack(motion[:3], axis=-1), jnp.stack(motion[3:], axis=-1)
    if num_bodies == 1:
        pose, twist = pose[..., None, :], twist[..., None, :]
    return State(pose=pose, twist=twist)
