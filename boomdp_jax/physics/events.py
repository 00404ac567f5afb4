"""When something happened: first times, regions reached, falls and contacts.

Each query turns a trajectory, a `State` with a leading time axis such as `rollout`
returns, into one flag per instant; `first_time` says when the first of them is up.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.core.arrays import FloatScalar, IntScalar
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.separation import pair_separation, separation
from boomdp_jax.physics.state import State

TOUCHING = 1e-3
"""Separation below which bodies count as touching [m]. Larger: near misses are hits;
smaller: bodies at rest on each other flicker with the rounding of a solver."""


Corner = Float[Array, "2"] | tuple[FloatScalar | float, FloatScalar | float]


class FirstTime(eqx.Module):
    """The first instant at which something held."""

    has_happened: Bool[Array, "*batch"]
    index: Int[Array, "*batch"]
    """Place along time; the number of instants if it never happened."""
    time: Float[Array, "*batch"]
    """Time since the start [s]; infinite if it never happened."""


def first_time(
    flags: Bool[Array, " time"], dt: Float[Array, " time"] | FloatScalar | float
) -> FirstTime:
    """Find the first flag that is up.

    Args:
        flags: whether it held after each step.
        dt: length of the steps [s], one for all or one for each. A flag belongs to the
            end of its step, as the states of `rollout` do.

    Returns:
        Whether, where and when it first held.
    """
    num_steps = flags.shape[0]
    has_happened = jnp.any(flags)
    index = jnp.where(has_happened, jnp.argmax(flags), num_steps)
    lengths = jnp.broadcast_to(jnp.asarray(dt, float), (num_steps,))
    is_past = jnp.arange(num_steps) <= index
    elapsed = jnp.sum(jnp.where(is_past, lengths, 0.0))
    return FirstTime(has_happened, index, jnp.where(has_happened, elapsed, jnp.inf))


def reached_region(
    states: State,
    body: IntScalar | int,
    lower: Corner,
    upper: Corner,
) -> Bool[Array, "*batch"]:
    """Whether a body's centre of mass is in a region along the axes of the world.

    Args:
        states: trajectory.
        body: index of the body.
        lower: least x and y of the region, which belong to it [m].
        upper: greatest x and y, likewise [m].

    Returns:
        One flag per instant.
    """
    x, y = states.pose[..., body, 0], states.pose[..., body, 1]
    is_inside_x = (lower[0] <= x) & (x <= upper[0])
    return is_inside_x & (lower[1] <= y) & (y <= upper[1])


def fell_over(
    states: State,
    body: IntScalar | int,
    max_angle: FloatScalar | float,
    *,
    upright: FloatScalar | float | None = None,
) -> Bool[Array, " time"]:
    r"""Whether a body leans too far, $|\theta - \theta_0|$ beyond a limit.

    Full turns are taken off: a wheel that has rolled round stands as it stood.

    Args:
        states: trajectory, time in front.
        body: index of the body.
        max_angle: lean beyond which it has fallen, in (0, π) [rad].
        upright: angle θ₀ at which it stands [rad]; default: that of the first state.

    Returns:
        One flag per instant.
    """
    theta = states.pose[:, body, 2]
    lean = theta - (theta[0] if upright is None else upright)
    lean = jnp.mod(lean + jnp.pi, 2.0 * jnp.pi) - jnp.pi
    return jnp.abs(lean) > max_angle


def contact_flags(
    scene: Scene, states: State, *, margin: FloatScalar | float = TOUCHING
) -> Bool[Array, "time body body"]:
    """Which bodies touch or overlap, at every instant.

    Args:
        scene: outlines.
        states: trajectory, time in front.
        margin: separation that counts as touching [m].

    Returns:
        One symmetric table of flags per instant; no body touches itself.
    """
    return jax.vmap(lambda state: separation(scene, state))(states) <= margin


def first_contact(
    scene: Scene,
    states: State,
    body_a: IntScalar | int,
    body_b: IntScalar | int,
    dt: Float[Array, " time"] | FloatScalar | float,
    *,
    margin: FloatScalar | float = TOUCHING,
) -> FirstTime:
    """Find when two bodies first touch.

    Instants are those of the trajectory: a fast body that is past another one after a
    step never touched it.

    Args:
        scene: outlines.
        states: trajectory, time in front.
        body_a: index of one body.
        body_b: index of another.
        dt: length of the steps [s], as in `first_time`.
        margin: separation that counts as touching [m].

    Returns:
        Whether, where and when they first touched.
    """
    apart = jax.vmap(lambda state: pair_separation(scene, state, body_a, body_b))
    return first_time(apart(states) <= margin, dt)
