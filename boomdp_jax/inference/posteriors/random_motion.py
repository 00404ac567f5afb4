"""Noise drawn: of readings, and of the motion between them."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import Key
from boomdp_jax.physics.state import State, state_from_array


def add_reading_noise(
    key: Key,
    state: State,
    noise_scale: Float[Array, "*#batch body 4"],
    is_static: Bool[Array, " body"],
    freedom: float | None = None,
) -> State:
    """Add independent noise to readings; a static body has none.

    Args:
        key: random key.
        state: true poses and twists.
        noise_scale: sd of position [m], angle [rad], velocity [m/s], spin [rad/s].
        is_static: which bodies are part of the room.
        freedom: degrees of freedom of Student-t noise, whose scale `noise_scale` then
            is; None: it is normal.

    Returns:
        The readings.
    """
    truth = state.array
    scale = noise_scale[..., jnp.array([0, 0, 1, 2, 2, 3])]
    scale = jnp.broadcast_to(scale, truth.shape)
    scale = jnp.where(jnp.broadcast_to(is_static[:, None], truth.shape), 0.0, scale)
    if freedom is None:
        noise = jax.random.normal(key, truth.shape, truth.dtype)
    else:
        noise = jax.random.t(key, freedom, truth.shape, truth.dtype)
    return state_from_array(truth + scale * noise)


def add_impulse(
    key: Key,
    state: State,
    impulse_scale: Float[Array, "body 2"] | None,
    is_static: Bool[Array, " body"],
) -> State:
    """Change velocities and spins at random, as the noise of a motion does.

    Args:
        key: random key.
        state: true poses and twists.
        impulse_scale: sd of the change of velocity [m/s] and spin [rad/s]; None: the
            motion is exact.
        is_static: which bodies are part of the room.

    Returns:
        The state that a step then starts from.
    """
    if impulse_scale is None:
        return state
    scale = impulse_scale[:, jnp.array([0, 0, 1])]
    scale = jnp.where(is_static[:, None], 0.0, scale)
    kick = scale * jax.random.normal(key, state.twist.shape, state.twist.dtype)
    return State(state.pose, state.twist + kick)
