"""What a likelihood of single steps needs of a history, for the bodies of one block."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.history import History
from boomdp_jax.physics.actuator import Commands, delayed, past_commands
from boomdp_jax.physics.params import Params


class Readings(eqx.Module):
    """What a likelihood needs of a history, for the bodies of one block."""

    state: Float[Array, "time body 6"]
    action: Float[Array, "time body 3"]
    next_state: Float[Array, "time body 6"]
    mask: Float[Array, "time body 6"]
    """One where a residual counts."""
    dt: Float[Array, " time"] | Float[Array, ""]
    """Scalar where all steps are equally long, which is cheaper."""
    commands: Commands | None = None
    """With those from before each step; None: they take effect at once."""


def in_effect(params: Params, data: Readings) -> Float[Array, "time body 3"]:
    """Commands that are in effect in each step."""
    return data.action if data.commands is None else delayed(params, data.commands)


def readings(
    history: History,
    bodies: tuple[int, ...],
    is_uniform: bool,
    *,
    has_delay: bool = False,
) -> Readings:
    """Take a block's bodies out of a history.

    Args:
        history: all of it.
        bodies: indices of the block's bodies.
        is_uniform: whether all steps are equally long.
        has_delay: whether commands may take effect later than they were given.

    Returns:
        Readings; a row whose first reading is incomplete does not count.
    """
    index, dtype = np.asarray(bodies), history.state.dtype

    def pick(array):
        return np.asarray(array)[:, index]

    is_whole = np.all(pick(history.state_mask), axis=(-2, -1), keepdims=True)
    counts = pick(history.next_state_mask) & is_whole
    counts &= np.asarray(history.mask)[:, None, None]
    dt = np.asarray(history.dt)
    commands = None
    if has_delay:
        is_start = np.diff(np.asarray(history.episode), prepend=np.nan) != 0
        commands = past_commands(pick(history.action), dt, is_start)
    return Readings(
        state=on_device(pick(history.state), dtype),
        action=on_device(pick(history.action), dtype),
        next_state=on_device(pick(history.next_state), dtype),
        mask=on_device(counts, dtype),
        dt=on_device(dt[0] if is_uniform else dt, dtype),
        commands=commands,
    )
