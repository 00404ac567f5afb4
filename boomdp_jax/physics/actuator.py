r"""What acts on bodies, given what was commanded: gain, bias and delay.

$$w(t) = g \, u(t - d) + b,$$

with u the commands, each held from its instant to the next. `step` takes the command
that is in effect and applies gain and bias; which one is in effect is up to whoever has
those that came before: `delayed`. Of a command that changes within a step the mean over
the step is applied, which gives the right twist after it, and the right place but for
$|\Delta w| \, \Delta t^2 / 8m$.

From motion that commands and friction alone drive, a gain and a mass cannot be told
apart: a scene that infers the one should know the other.
"""

import dataclasses
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import on_device
from boomdp_jax.physics.params import Params

LONGEST_DELAY = 0.5
"""Commands from so long ago are kept [s], though no more than 64 of them: one that lags
more takes effect then."""

_MOST_PAST = 64


class Commands(eqx.Module):
    """Commands in effect in some steps, and those from before each of them."""

    wrench: Float[Array, "time past body 3"]
    """World frame [N, N, N m]: the step's own, the one before it, and so on; zero from
    before a run."""
    age: Float[Array, "time past"]
    """How long before the step began each was given [s]: zero for its own."""
    length: Float[Array, " time"]
    """Of the steps [s]."""


def past_commands(
    wrench: Float[np.ndarray, "time body 3"],
    dt: Float[np.ndarray, " time"],
    is_start: Bool[np.ndarray, " time"],
    *,
    longest: float = LONGEST_DELAY,
) -> Commands:
    """Arrange a table of commands so that delays can be applied to it.

    Args:
        wrench: commands held over each step [N, N, N m].
        dt: length of the steps [s].
        is_start: where a run begins, before which nothing was commanded.
        longest: delay to make room for [s].

    Returns:
        Up to 64 commands for each step, on the float type of `wrench`.
    """
    num_rows = len(dt)
    shortest = float(dt.min()) if num_rows else longest
    num = min(math.ceil(longest / shortest - 1e-9) + 1, _MOST_PAST)
    wrench = np.asarray(wrench)
    row = np.arange(num_rows)
    first = np.maximum.accumulate(np.where(is_start, row, 0))
    begin = np.concatenate([[0.0], np.cumsum(dt)])[:-1]
    source = row[:, None] - np.arange(num)[None]
    is_there = source >= first[:, None]
    source = np.maximum(source, first[:, None])
    dtype = wrench.dtype
    in_reach = np.where(is_there[..., None, None], wrench[source], 0.0)
    return Commands(
        wrench=on_device(in_reach, dtype),
        # Nothing was commanded until the run began, however long before.
        age=on_device(begin[:, None] - begin[source], dtype),
        length=on_device(dt, dtype),
    )


def delayed(params: Params, commands: Commands) -> Float[Array, "time body 3"]:
    """Commands in effect in each step, its mean over the step.

    Args:
        params: one hypothesis.
        commands: as they were given.

    Returns:
        What `step` takes, each step's own where there is no delay.
    """
    own = commands.wrench[:, 0]
    if params.actuator is None or params.actuator.delay is None:
        return own
    delay = params.actuator.delay[None, None]
    begin = -commands.age
    end = jnp.concatenate([commands.length[:, None], begin[:, :-1]], axis=1)
    begin, end = begin[..., None], end[..., None]
    length = commands.length[:, None, None]
    # The oldest was in effect ever since; of a run's first nothing is older.
    is_oldest = (jnp.arange(begin.shape[1]) == begin.shape[1] - 1)[None, :, None]
    until = jnp.minimum(end, length - delay)
    since = jnp.where(is_oldest, -delay, jnp.maximum(begin, -delay))
    share = jnp.maximum(until - since, 0.0) / length
    return jnp.sum(share[..., None] * commands.wrench, axis=1)


def delayed_wrenches(
    params: Params,
    wrenches: Float[Array, "time body 3"] | Float[np.ndarray, "time body 3"],
    dt: Float[Array, " time"] | Float[np.ndarray, " time"] | float,
    *,
    is_start: Bool[np.ndarray, " time"] | None = None,
) -> Float[Array, "time body 3"]:
    """Commands of a table as they take effect, for `rollout` or `step`.

    Args:
        params: one hypothesis.
        wrenches: commands held over each step [N, N, N m].
        dt: length of the steps [s], one for all or one for each.
        is_start: where runs begin; default: with the first step.

    Returns:
        What is in effect in each step, gain and bias still to come.
    """
    num_rows = len(wrenches)
    lengths = np.broadcast_to(np.asarray(dt, float), (num_rows,))
    if is_start is None:
        is_start = np.arange(num_rows) == 0
    return delayed(params, past_commands(np.asarray(wrenches), lengths, is_start))


def applied(
    params: Params, wrench: Float[Array, "body 3"], is_static: Bool[Array, " body"]
) -> Float[Array, "body 3"]:
    """What acts on bodies while a command is in effect.

    Args:
        params: one hypothesis.
        wrench: in effect, world frame [N, N, N m].
        is_static: bodies that nothing acts on.

    Returns:
        The wrench, with gain and bias.
    """
    actuator = params.actuator
    if actuator is None:
        return wrench
    if actuator.gain is not None:
        wrench = actuator.gain[:, None] * wrench
    if actuator.bias is not None:
        wrench = wrench + jnp.where(is_static[:, None], 0.0, actuator.bias)
    return wrench


def without_actuator(params: Params) -> Params:
    """The same bodies, for wrenches that are known to act."""
    return dataclasses.replace(params, actuator=None)
