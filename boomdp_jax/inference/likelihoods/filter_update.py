"""Covariances of a filter moved on and corrected: in scalars, or along lanes.

The six channels of one body are worked out in scalars, one loop over a batch; those of
several bodies as arrays with the batch as their last axis, since so many scalars would
take too long to compile.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.lanes import in_lanes
from boomdp_jax.core.one_loop import one_loop

_MOST_IN_SCALARS = 6
_LOG_TURN = math.log(2.0 * math.pi)


def correct(
    covariance: Float[Array, "channel channel"],
    miss: Float[Array, " channel"],
    mask: Float[Array, " channel"],
    variance: Float[Array, " channel"],
):
    """Take a reading with independent noise, one channel after the other.

    Args:
        covariance: of the state.
        miss: reading minus state.
        mask: one where a channel was read.
        variance: of the reading.

    Returns:
        Shift of the state, its new covariance, log-density of the reading.
    """
    if miss.shape[0] > _MOST_IN_SCALARS:
        return in_lanes(_correct_in_lanes, covariance, miss, mask, variance)
    found = one_loop(_correct, *_scalars(covariance, miss, mask, variance))
    return _arrays(*found)


def move_and_correct(
    covariance: Float[Array, "channel channel"],
    rise: Float[Array, "start channel"],
    scale: Float[Array, " channel"],
    kick: Float[Array, " channel"],
    miss: Float[Array, " channel"],
    mask: Float[Array, " channel"],
    variance: Float[Array, " channel"],
):
    """Move a covariance through a step, then take a reading.

    Args:
        covariance: of the state before the step.
        rise: change of the image where one channel of the start rises by `scale`.
        scale: by which starts were moved.
        kick: variance of what the motion adds to each channel of the start.
        miss: as for `correct`, like the rest.
        mask: see there.
        variance: see there.

    Returns:
        As `correct`.
    """
    arrays = (covariance, rise, scale, kick, miss, mask, variance)
    if miss.shape[0] > _MOST_IN_SCALARS:
        return in_lanes(_move_and_correct_in_lanes, *arrays)
    return _arrays(*one_loop(_move_and_correct, *_scalars(*arrays)))


def move(
    covariance: Float[Array, "channel channel"],
    rise: Float[Array, "start channel"],
    scale: Float[Array, " channel"],
    kick: Float[Array, " channel"],
) -> Float[Array, "channel channel"]:
    """Move a covariance through a step; arguments as for `move_and_correct`."""
    return in_lanes(_move_in_lanes, covariance, rise, scale, kick)


def start_and_correct_channels(is_start, at_start, lower, miss, mask, variance):
    """As `correct`, of scalars; a track that starts here forgets what was before.

    Args:
        is_start: one where a track starts, else zero.
        at_start: variance of each channel there.
        lower: rows of the lower triangle of the covariance.
        miss: of each channel.
        mask: of each.
        variance: of each.

    Returns:
        Shift of each channel, the new lower triangle, log-density.
    """
    arguments = (is_start, at_start, lower, miss, mask, variance)
    return one_loop(_start_and_correct, *arguments)


def move_and_correct_channels(lower, rise, scale, kick, miss, mask, variance):
    """As `move_and_correct`, of scalars and lower triangles."""
    arguments = (lower, rise, scale, kick, miss, mask, variance)
    return one_loop(_move_and_correct_lower, *arguments)


def _scalars(*arrays: Array) -> list:
    """Arrays as lists of scalars, matrices as lists of rows."""
    return [
        [row if row.ndim == 0 else list(row) for row in list(array)] for array in arrays
    ]


def _arrays(shift, covariance, density):
    """What a function of scalars returns, symmetric matrices from lower triangles."""
    num = len(shift)
    rows = [
        jnp.stack([covariance[max(i, j)][min(i, j)] for j in range(num)])
        for i in range(num)
    ]
    return jnp.stack(shift), jnp.stack(rows), density


def _move_and_correct(covariance, rise, scale, kick, miss, mask, variance):
    num = range(len(miss))
    inverse = [1.0 / scale[k] for k in num]
    slope = [[rise[k][i] * inverse[k] for k in num] for i in num]
    spread = [list(row) for row in covariance]
    for k in num:
        spread[k][k] = spread[k][k] + kick[k]
    half = [[_dot(slope[i], spread[j]) for j in num] for i in num]
    moved = [[_dot(half[i], slope[j]) for j in range(i + 1)] for i in num]
    return _correct_lower(moved, miss, mask, variance)


def _move_and_correct_lower(lower, *rest):
    num = range(len(lower))
    covariance = [[lower[max(i, j)][min(i, j)] for j in num] for i in num]
    return _move_and_correct(covariance, *rest)


def _start_and_correct(is_start, at_start, lower, miss, mask, variance):
    kept = 1.0 - is_start
    lower = [[kept * x for x in row] for row in lower]
    for i, row in enumerate(lower):
        row[i] = row[i] + is_start * at_start[i]
    return _correct_lower(lower, miss, mask, variance)


def _correct(covariance, miss, mask, variance):
    lower = [row[: i + 1] for i, row in enumerate(covariance)]
    return _correct_lower(lower, miss, mask, variance)


def _correct_lower(lower, miss, mask, variance):
    """In scalars, of a lower triangle."""
    num = range(len(miss))
    shift: list = [0.0 for _ in num]
    density = 0.0
    for c in num:
        column = [lower[max(i, c)][min(i, c)] for i in num]
        spread = column[c] + variance[c]
        inverse = 1.0 / spread
        error = miss[c] - shift[c]
        gain = [mask[c] * x * inverse for x in column]
        shift = [x + g * error for x, g in zip(shift, gain, strict=True)]
        lower = [[lower[i][j] - gain[i] * column[j] for j in range(i + 1)] for i in num]
        each = jnp.log(spread) + _LOG_TURN + error * error * inverse
        density = density - 0.5 * mask[c] * each
    return shift, lower, density


def _dot(left, right):
    total = left[0] * right[0]
    for x, y in zip(left[1:], right[1:], strict=True):
        total = total + x * y
    return total


def _move_and_correct_in_lanes(covariance, rise, scale, kick, miss, mask, variance):
    moved = _move_in_lanes(covariance, rise, scale, kick)
    return _correct_in_lanes(moved, miss, mask, variance)


def _move_in_lanes(covariance, rise, scale, kick):
    num = range(scale.shape[0])
    # By start channel: rows of `slope` are columns of the derivative.
    slope = rise * (1.0 / scale)[:, None]
    half = sum(slope[k][:, None] * covariance[k][None] for k in num)
    moved = sum(half[:, k][:, None] * slope[k][None] for k in num)
    shaken = slope * kick[:, None]
    return moved + sum(shaken[k][:, None] * slope[k][None] for k in num)


def _correct_in_lanes(covariance, miss, mask, variance):
    def one_channel(c, carry):
        covariance, shift, density = carry
        column = covariance[:, c]
        spread = column[c] + variance[c]
        error = miss[c] - shift[c]
        gain = column * (mask[c] / spread)[None]
        shift = shift + gain * error[None]
        covariance = covariance - gain[:, None] * column[None]
        each = jnp.log(spread) + _LOG_TURN + error**2 / spread
        return covariance, shift, density - 0.5 * mask[c] * each

    carry = (covariance, jnp.zeros_like(miss), jnp.zeros_like(miss[0]))
    covariance, shift, density = jax.lax.fori_loop(0, miss.shape[0], one_channel, carry)
    return shift, covariance, density
