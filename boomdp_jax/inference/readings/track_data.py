"""Readings in the order in which a filter takes them: start, second reading, next."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.history import History
from boomdp_jax.inference.readings.outliers import without_isolated
from boomdp_jax.inference.readings.single_steps import Readings, in_effect, readings
from boomdp_jax.physics.params import Params


class TrackRow(NamedTuple):
    """One row of a `TrackData`, or all of them with a leading time axis."""

    is_start: Float[Array, "*time"]
    is_second: Float[Array, "*time body 6"]
    start: Float[Array, "*time body 6"]
    first: Float[Array, "*time body 6"]
    first_mask: Float[Array, "*time body 6"]
    action: Float[Array, "*time body 3"]
    last: Float[Array, "*time body 6"]
    last_mask: Float[Array, "*time body 6"]
    dt: Float[Array, "*time"] | None
    """None where all steps are equally long."""
    weight: Float[Array, "*time"] | None
    may_touch: Bool[Array, "*time"] | None = None


class TrackData(eqx.Module):
    """What a filter needs of a history, for the bodies of one block.

    A row either starts a track at its own first reading, or goes on from the row
    before; then each channel of its first reading is either the very one that ended the
    row before, or another reading of the same instant.
    """

    steps: Readings
    """The rows taken one by one; `steps.mask` counts those whose start is known."""
    first_mask: Float[Array, "time body 6"]
    """One where the first reading of a row was read."""
    last_mask: Float[Array, "time body 6"]
    """One where the last reading of a row was read."""
    is_start: Float[Array, " time"]
    is_second: Float[Array, "time body 6"]
    """One where a row that goes on has a first reading that did not end the one before,
    to be taken in before the row: a second one, or the only one of that channel."""
    start: Float[Array, "time body 6"]
    """Where a track would start in each row: readings, or a guess where missing."""
    weight: Float[Array, " time"] | None = None
    """As how many times its likelihood each row counts; None: as one."""
    freedom: float | None = eqx.field(static=True, default=None)
    """Degrees of freedom of the readings' Student-t noise; None: it is normal."""
    may_touch: Bool[Array, " time"] | None = None
    """Rows in which bodies may touch something; None: all, where there is contact."""

    @property
    def is_used(self) -> Bool[Array, "*batch time"]:
        """Whether a row, or some row after it, was read or goes on from another."""
        read = jnp.any((self.first_mask > 0) | (self.last_mask > 0), axis=(-2, -1))
        row = read | (self.is_start == 0)
        num_left = jnp.cumsum(jnp.flip(row, -1), axis=-1)
        return jnp.flip(num_left, -1) > 0

    @property
    def rows(self) -> TrackRow:
        """All rows, to be scanned over."""
        return TrackRow(
            is_start=self.is_start,
            is_second=self.is_second,
            start=self.start,
            first=self.steps.state,
            first_mask=self.first_mask,
            action=self.steps.action,
            last=self.steps.next_state,
            last_mask=self.last_mask,
            dt=self.steps.dt if self.steps.dt.ndim else None,
            weight=self.weight,
            may_touch=self.may_touch,
        )


def with_delay(params: Params, data: TrackData) -> TrackData:
    """The same with the commands that a hypothesis has in effect in each row."""
    if data.steps.commands is None:
        return data
    return eqx.tree_at(lambda d: d.steps.action, data, in_effect(params, data.steps))


def track_data(
    history: History,
    bodies: tuple[int, ...],
    is_uniform: bool,
    *,
    has_delay: bool = False,
    freedom: float | None = None,
) -> TrackData:
    """Take a block's bodies out of a history.

    Args:
        history: all of it.
        bodies: indices of the block's bodies.
        is_uniform: whether all steps are equally long.
        has_delay: whether commands may take effect later than they were given.
        freedom: degrees of freedom of the readings' noise; None: it is normal. Readings
            far from their neighbours are then not started from, nor stepped from one
            by one.

    Returns:
        The readings. A missing first reading of a track is replaced by the next one of
        that run, where there is none by the mean position, or by rest; how little is
        known of it is up to the filter.
    """
    index = np.asarray(bodies)
    trusted = history if freedom is None else without_isolated(history)
    steps = readings(trusted, bodies, is_uniform, has_delay=has_delay)
    dtype = steps.state.dtype
    state, rows = np.asarray(steps.state), np.asarray(history.mask)
    first = np.asarray(history.state_mask)[:, index] & rows[:, None, None]
    last = np.asarray(history.next_state_mask)[:, index] & rows[:, None, None]
    is_new = history.is_start_new(bodies)
    episode = np.asarray(history.episode)
    same = np.zeros(rows.shape, bool)
    same[1:] = (episode[1:] == episode[:-1]) & rows[:-1]
    goes_on = rows & same
    if freedom is not None:
        seen = np.asarray(trusted.state_mask)[:, index]
        first &= seen | goes_on[:, None, None]
    num = np.maximum(np.sum(first, axis=0), 1)
    mean = np.sum(np.where(first, state, 0.0), axis=0) / num
    guess = np.where(np.arange(6)[None] < 3, mean, 0.0)
    guess = np.where(first, state, guess[None])
    later = np.asarray(trusted.next_state_mask)[:, index] & rows[:, None, None]
    _fill_poses(guess, first, np.asarray(steps.next_state), later, goes_on)
    return TrackData(
        steps=steps,
        first_mask=on_device(first, dtype),
        last_mask=on_device(last, dtype),
        is_start=on_device(~goes_on, dtype),
        is_second=on_device(goes_on[:, None, None] & is_new, dtype),
        start=on_device(guess, dtype),
        freedom=freedom,
    )


def _fill_poses(
    start: np.ndarray,
    first: np.ndarray,
    after: np.ndarray,
    last: np.ndarray,
    goes_on: np.ndarray,
) -> None:
    """Put the next reading of a run in place of first ones that are missing, of poses.

    The filter takes derivatives about it, and those about an angle that is off by a
    radian mean nothing.
    """
    if np.all(first[~goes_on][..., :3]):
        return
    is_known, value = first[..., :3].copy(), start[..., :3]
    for row in reversed(range(len(start))):
        choices = [(last[row, :, :3], after[row, :, :3])]
        if row + 1 < len(start) and goes_on[row + 1]:
            choices.append((is_known[row + 1], value[row + 1]))
        for is_there, other in choices:
            is_new = is_there & ~is_known[row]
            value[row] = np.where(is_new, other, value[row])
            is_known[row] |= is_new
