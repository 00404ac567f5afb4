"""The table of an online belief: a new row at its end, old ones off its front."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, IntScalar, on_device
from boomdp_jax.core.checked_input import positive_seconds
from boomdp_jax.core.history import History, is_read_anew, make_history
from boomdp_jax.inference.readings.track_data import TrackData, TrackRow


class NewRow(NamedTuple):
    """One transition of all bodies, as a `History` holds it."""

    state: Float[Array, "body 6"]
    action: Float[Array, "body 3"]
    next_state: Float[Array, "body 6"]
    dt: FloatScalar
    state_mask: Bool[Array, "body 6"]
    next_state_mask: Bool[Array, "body 6"]
    starts_episode: BoolScalar
    is_chained: BoolScalar
    is_start_new: Bool[Array, "body 6"]
    """As `History` has them."""


def empty_table(num_bodies: int, capacity: int, dt: float) -> History:
    """A table of no transitions yet, with room for some.

    Args:
        num_bodies: of the scene.
        capacity: rows there is room for.
        dt: usual length of a step [s].
    """
    none = np.zeros((0, num_bodies, 6))
    history = make_history(none, none[..., :3], none, dt, capacity=capacity)
    return eqx.tree_at(lambda h: h.dt, history, on_device(np.full(capacity, dt)))


def can_happen(action: Float[Array, "body 3"], dt: FloatScalar) -> BoolScalar:
    """Whether wrenches and a length are those of a step."""
    return jnp.all(jnp.isfinite(action)) & jnp.isfinite(dt) & (dt > 0)


def step_length(dt: Any, usual: float, *, is_uniform: bool) -> Array:
    """Length of a step as it was given, or the usual one.

    Args:
        dt: what was given, None for the usual one.
        usual: of all steps [s].
        is_uniform: whether all are equal.

    Raises:
        ValueError: a length where all are equal, or none where they vary; one that is
            known not to be positive and finite.
    """
    if (dt is None) != is_uniform:
        expected = "none" if is_uniform else "seconds"
        raise ValueError(
            f"dt: expected {expected}, with has_varying_dt={not is_uniform}; got {dt}"
        )
    if dt is None or isinstance(dt, jax.core.Tracer):
        return jnp.asarray(usual if dt is None else dt, float)
    return jnp.asarray(positive_seconds("dt", dt), float)


def new_row(
    history: History,
    num_rows: IntScalar,
    state: Float[Array, "body 6"],
    action: Float[Array, "body 3"],
    next_state: Float[Array, "body 6"],
    dt: FloatScalar,
    starts_episode: BoolScalar,
) -> NewRow:
    """Sort out what was read, and how the row hangs together with the one before.

    Readings that are not finite count as missing. A wrench that is not finite or a
    length that no step has leaves nothing that could be learnt from the row: all its
    readings count as missing, and what was known of the state is lost.

    Args:
        history: the table so far.
        num_rows: rows of it in use.
        state: reading before the step.
        action: wrench.
        next_state: reading after the step.
        dt: length of the step [s].
        starts_episode: whether bodies were moved between the last row and this one.
    """
    is_pushed = can_happen(action, dt)
    first = jnp.isfinite(state) & is_pushed
    last = jnp.isfinite(next_state) & is_pushed
    state = jnp.where(first, state, 0.0).astype(history.state.dtype)
    next_state = jnp.where(last, next_state, 0.0).astype(history.state.dtype)
    before = jnp.maximum(num_rows - 1, 0)
    was_read = history.next_state_mask[before]
    is_new = is_read_anew(state, first, history.next_state[before], was_read)
    starts_episode = starts_episode | (num_rows == 0) | ~is_pushed
    return NewRow(
        state=state,
        action=jnp.where(is_pushed, action, 0.0).astype(history.action.dtype),
        next_state=next_state,
        dt=jnp.where(is_pushed, dt, history.dt[before]).astype(history.dt.dtype),
        state_mask=first,
        next_state_mask=last,
        starts_episode=starts_episode,
        is_chained=~jnp.any(is_new & was_read) & ~starts_episode,
        is_start_new=jnp.where(starts_episode, first, is_new),
    )


def table_of(empty: History, history: History, dt: float | None) -> History:
    """A history's rows in a table.

    Args:
        empty: the table, of a capacity.
        history: transitions.
        dt: length of all steps [s]; None: lengths vary.

    Raises:
        ValueError: more transitions than there is room for, steps of another length.
    """
    mask = np.asarray(history.mask)
    num_rows = int(mask.sum())
    if num_rows > empty.capacity:
        raise ValueError(
            f"history: expected at most {empty.capacity} transitions, the capacity; "
            f"got {num_rows}"
        )
    lengths = np.asarray(history.dt, float)[mask]
    if dt is not None and not np.allclose(lengths, dt, rtol=1e-5):
        raise ValueError(
            f"history: expected steps of {dt} s, or has_varying_dt; got "
            f"{lengths[np.argmax(np.abs(lengths - dt))]}"
        )
    rows = np.flatnonzero(mask)

    def put(table: Array, leaf: Array) -> Array:
        array = np.array(table)
        array[:num_rows] = np.asarray(leaf)[rows]
        return on_device(array, array.dtype)

    return jax.tree.map(put, empty, history)


def append_row(history: History, num_rows: IntScalar, row: NewRow) -> History:
    """Write a row behind the last one; there has to be room."""
    before = history.episode[jnp.maximum(num_rows - 1, 0)]
    return History(
        state=history.state.at[num_rows].set(row.state),
        action=history.action.at[num_rows].set(row.action),
        next_state=history.next_state.at[num_rows].set(row.next_state),
        dt=history.dt.at[num_rows].set(row.dt),
        episode=history.episode.at[num_rows].set(before + row.starts_episode),
        mask=history.mask.at[num_rows].set(True),
        state_mask=history.state_mask.at[num_rows].set(row.state_mask),
        next_state_mask=history.next_state_mask.at[num_rows].set(row.next_state_mask),
        is_chained=history.is_chained.at[num_rows].set(row.is_chained),
    )


def shift_rows(tree, num: int):
    """Move the rows of a table so many places forward; the last ones become zero.

    Args:
        tree: arrays with a leading time axis.
        num: rows that leave.
    """

    def shift(leaf: Array) -> Array:
        return jnp.roll(leaf, -num, axis=0).at[-num:].set(jnp.zeros((), leaf.dtype))

    return jax.tree.map(shift, tree)


def track_row_of(
    data: TrackData, row: NewRow, bodies: Array, is_start: BoolScalar
) -> TrackRow:
    """The row as the filter of a block takes it; see `track_data`.

    Args:
        data: the block's table so far.
        row: readings of the whole scene.
        bodies: indices of the block's bodies.
        is_start: whether a track starts here.
    """
    dtype = data.start.dtype
    state, first = row.state[bodies], row.state_mask[bodies]
    seen = jnp.maximum(jnp.sum(data.first_mask, axis=0), 1.0)
    mean = jnp.sum(data.first_mask * data.steps.state, axis=0) / seen
    guess = jnp.where(jnp.arange(6)[None] < 3, mean, 0.0)
    is_second = ~is_start & row.is_start_new[bodies]
    one = jnp.ones((), dtype)
    return TrackRow(
        is_start=is_start.astype(dtype),
        is_second=is_second.astype(dtype),
        start=jnp.where(first, state, guess),
        first=state,
        first_mask=first.astype(dtype),
        action=row.action[bodies],
        last=row.next_state[bodies],
        last_mask=row.next_state_mask[bodies].astype(dtype),
        dt=row.dt if data.steps.dt.ndim else None,
        weight=None if data.weight is None else one,
    )


def append_track_row(
    data: TrackData, index: IntScalar, row: TrackRow, forgetting: float
) -> TrackData:
    """Write a row into a block's table; all others count for a little less."""
    steps = data.steps
    whole = jnp.all(row.first_mask > 0)
    weight = data.weight
    if weight is not None:
        weight = (forgetting * weight).at[index].set(1.0)
    return TrackData(
        steps=type(steps)(
            state=steps.state.at[index].set(row.first),
            action=steps.action.at[index].set(row.action),
            next_state=steps.next_state.at[index].set(row.last),
            mask=steps.mask.at[index].set(row.last_mask * whole),
            dt=steps.dt if row.dt is None else steps.dt.at[index].set(row.dt),
        ),
        first_mask=data.first_mask.at[index].set(row.first_mask),
        last_mask=data.last_mask.at[index].set(row.last_mask),
        is_start=data.is_start.at[index].set(row.is_start),
        is_second=data.is_second.at[index].set(row.is_second),
        start=data.start.at[index].set(row.start),
        weight=weight,
    )


def drop_track_rows(
    data: TrackData, starts: Float[Array, "time body 6"], num: int
) -> TrackData:
    """Take the oldest rows off; what they told of the state stays as a start.

    Args:
        data: a block's table.
        starts: state before each row as the filter had it.
        num: rows that leave.
    """
    steps, dt = data.steps, data.steps.dt
    parts = (steps.state, steps.action, steps.next_state, steps.mask)
    state, action, next_state, mask = shift_rows(parts, num)
    rest = (data.first_mask, data.last_mask, data.is_second, data.weight)
    first_mask, last_mask, is_second, weight = shift_rows(rest, num)
    start = jnp.where(data.is_start[num] > 0, data.start[num], starts[num])
    return TrackData(
        steps=type(steps)(
            state, action, next_state, mask, shift_rows(dt, num) if dt.ndim else dt
        ),
        first_mask=first_mask,
        last_mask=last_mask,
        is_start=shift_rows(data.is_start, num).at[0].set(1.0),
        is_second=is_second,
        start=shift_rows(data.start, num).at[0].set(start),
        weight=weight,
    )
