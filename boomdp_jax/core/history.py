"""What was observed: a fixed-capacity, masked table of transitions."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.core.applied_force import wrench_at_reference
from boomdp_jax.core.arrays import IntScalar, on_device
from boomdp_jax.core.checked_input import (
    check_fits,
    check_positive_seconds,
    episode_array,
    real_array,
    whole_number,
)

_SAME_READING = 1e-6


def is_same_reading(one: Any, other: Any) -> Any:
    """Whether numbers read at one instant are one reading, up to rounding.

    One that was rounded to single precision on its way, or to six decimals in a text
    file, differs by up to a millionth, as a share or in m, rad, m/s or rad/s. Taken for
    two readings they would tell of sensors without noise.
    """
    return abs(one - other) <= _SAME_READING * (1.0 + abs(one))


def is_read_anew(now: Any, is_read: Any, before: Any, was_read: Any) -> Any:
    """Which channels of where a row starts are not those that the row before ended at.

    The pose of a body is read at once, and so are its velocities: of those channels
    that were read both times either all are one reading or none is. (Of two readings
    that are rounded a few channels agree by chance; leaving those out would tell of
    noise that is not there.) A channel that was read the second time only is new,
    whatever the others are.

    Args:
        now: readings that a row starts from, `[*any, body, 6]`.
        is_read: which of them there are.
        before: readings that the row before ended at.
        was_read: which of them there are.

    Returns:
        True where there is a reading to learn from, `[*any, body, 6]`.
    """

    def parts(channels: Any) -> Any:
        return channels.reshape(*channels.shape[:-1], 2, 3)

    differs = parts(is_read & was_read & ~is_same_reading(now, before))
    is_new = differs.any(axis=-1, keepdims=True) | ~parts(was_read)
    return is_read & is_new.reshape(is_read.shape)


class Transition(eqx.Module):
    """One observed step (s, a, s') of every body.

    A state holds x, y, theta, xdot, ydot, thetadot of a body's centre of mass [m,
    rad, m/s, rad/s]; the action is the wrench (f_x, f_y, tau) at the centre of mass
    [N, N, N m], held over `dt` [s].
    """

    state: Float[Array, "*batch body 6"]
    action: Float[Array, "*batch body 3"]
    next_state: Float[Array, "*batch body 6"]
    dt: Float[Array, "*batch"]


class History(eqx.Module):
    """A table of transitions with a mask, so that a longer history never recompiles.

    Missing readings are masked channel by channel and hold zero. `is_chained[t]` says
    that no channel was read twice between rows `t - 1` and `t` of a run: what
    `state[t]` and `next_state[t - 1]` both hold is the very same, up to rounding
    (`is_same_reading`), and either may lack channels that the other has.
    """

    state: Float[Array, "*batch time body 6"]
    action: Float[Array, "*batch time body 3"]
    next_state: Float[Array, "*batch time body 6"]
    dt: Float[Array, "*batch time"]
    episode: Int[Array, "*batch time"]
    mask: Bool[Array, "*batch time"]
    state_mask: Bool[Array, "*batch time body 6"]
    next_state_mask: Bool[Array, "*batch time body 6"]
    is_chained: Bool[Array, "*batch time"]

    @property
    def num_transitions(self) -> IntScalar:
        """How many rows are in use."""
        return jnp.sum(self.mask, axis=-1)

    @property
    def capacity(self) -> int:
        """How many rows there is room for."""
        return self.mask.shape[-1]

    @property
    def num_bodies(self) -> int:
        """How many bodies a row describes."""
        return self.state.shape[-2]

    @property
    def transitions(self) -> Transition:
        """All rows, masked ones included."""
        return Transition(self.state, self.action, self.next_state, self.dt)

    def is_start_new(self, bodies: Sequence[int]) -> Bool[np.ndarray, "time body 6"]:
        """Which readings of `state` are not those that the row before ended at.

        Args:
            bodies: indices of those asked about.

        Returns:
            True for readings that a filter has not taken in with the row before; worked
            out on the host, of a history without a batch axis.
        """
        index = np.asarray(bodies)
        rows, episode = np.asarray(self.mask), np.asarray(self.episode)
        first, is_read, last, was_read = (
            np.asarray(leaf)[:, index]
            for leaf in (
                self.state,
                self.state_mask,
                self.next_state,
                self.next_state_mask,
            )
        )
        is_new = is_read & rows[:, None, None]
        starts = ~(rows[:-1] & (episode[1:] == episode[:-1]))[:, None, None]
        is_new[1:] &= starts | is_read_anew(
            first[1:], is_read[1:], last[:-1], was_read[:-1]
        )
        return is_new

    def padded(self, capacity: int) -> "History":
        """The same table with room for more rows, on the host.

        Args:
            capacity: rows to make room for.

        Returns:
            The history, itself if it has that capacity.

        Raises:
            ValueError: fewer than it has, or no whole number.
        """
        capacity = whole_number("capacity", capacity, 0)
        more = capacity - self.capacity
        if more < 0:
            raise ValueError(
                f"capacity: expected at least {self.capacity} rows, got {capacity}"
            )
        if more == 0:
            return self

        def pad(leaf: Array, axis: int, fill: float | int = 0) -> Array:
            width = [(0, 0)] * leaf.ndim
            width[axis] = (0, more)
            array = np.asarray(leaf)
            return on_device(np.pad(array, width, constant_values=fill), array.dtype)

        first = np.asarray(self.dt).reshape(-1)[:1]

        return History(
            state=pad(self.state, -3),
            action=pad(self.action, -3),
            next_state=pad(self.next_state, -3),
            # A step of no length would be another length.
            dt=pad(self.dt, -1, float(first[0]) if first.size else 1.0),
            episode=pad(self.episode, -1, -1),
            mask=pad(self.mask, -1),
            state_mask=pad(self.state_mask, -3),
            next_state_mask=pad(self.next_state_mask, -3),
            is_chained=pad(self.is_chained, -1),
        )


def make_history(
    state: np.ndarray | Array,
    action: np.ndarray | Array,
    next_state: np.ndarray | Array,
    dt: np.ndarray | Array | float,
    *,
    episode: np.ndarray | None = None,
    point: np.ndarray | None = None,
    point_frame: str = "world",
    capacity: int | None = None,
) -> History:
    """Check a table of transitions and pad it to a capacity.

    Args:
        state: readings before each step, `[time, body, 6]`; NaN marks a missing one.
        action: wrenches at the centre of mass (the reference point of the states, if
            that is unknown), `[time, body, 3]` [N, N, N m].
        next_state: readings after each step, like `state`.
        dt: length of a step [s], one for all or one per row.
        episode: which run a row belongs to, `[time]`; default: one run.
        point: where the force acts instead, `[time, body, 2]` [m]; NaN twice: there.
        point_frame: of those points, `world`, or `body`: about the reference point,
            along the axes of the body as it was read before the step.
        capacity: rows to make room for; default: as many as there are.

    Returns:
        The history, on the default float type.

    Raises:
        ValueError: a wrong shape, what is no real number, an action that is not finite,
            a step length that is not positive, an infinite reading, numbers that the
            float type cannot hold, an episode that is no whole number of 32 bit or is
            taken up again, an unknown frame, a force at a point of a body that was not
            seen, or more rows than the capacity.
    """
    if point_frame not in ("world", "body"):
        raise ValueError(f"point_frame: expected world or body, got {point_frame!r}")
    state, action = real_array("state", state), real_array("action", action)
    next_state, dt = real_array("next_state", next_state), real_array("dt", dt)
    if state.ndim != 3 or state.shape[-1] != 6:
        raise ValueError(f"state: expected shape [time, body, 6], got {state.shape}")
    num_rows, num_bodies = state.shape[:2]
    capacity = num_rows if capacity is None else whole_number("capacity", capacity, 0)
    if capacity < num_rows:
        raise ValueError(f"capacity: expected at least {num_rows} rows, got {capacity}")
    expected = {
        "action": (action, (num_rows, num_bodies, 3)),
        "next_state": (next_state, (num_rows, num_bodies, 6)),
    }
    if point is not None:
        point = real_array("point", point)
        expected["point"] = (point, (num_rows, num_bodies, 2))
    for name, (array, shape) in expected.items():
        if array.shape != shape:
            raise ValueError(f"{name}: expected shape {shape}, got {array.shape}")
    episode = episode_array(
        np.zeros(num_rows) if episode is None else episode, num_rows
    )
    dt = _each_dt(dt, num_rows)
    if not np.all(np.isfinite(action)):
        row, body, _ = np.argwhere(~np.isfinite(action))[0]
        raise ValueError(
            f"action: expected finite wrenches, got {action[row, body]} in row {row}, "
            f"body {body}"
        )
    for name, array in (("state", state), ("next_state", next_state)):
        if np.any(np.isinf(array)):
            row, body, _ = np.argwhere(np.isinf(array))[0]
            raise ValueError(
                f"{name}: expected finite readings or NaN for a missing one, got "
                f"{array[row, body]} in row {row}, body {body}"
            )
        check_fits(name, array)
    check_fits("action", action)
    if point is not None:
        needed = 2 if point_frame == "world" else 3
        _check_point(action, point, state[..., :needed])
        action = wrench_at_reference(action, point, state[..., :3], frame=point_frame)
        check_fits("action", action)
    is_chained = np.zeros(num_rows, bool)
    if num_rows > 1:
        now, before = state[1:], next_state[:-1]
        is_read, was_read = ~np.isnan(now), ~np.isnan(before)
        is_twice = was_read & is_read_anew(now, is_read, before, was_read)
        same = ~np.any(is_twice, axis=(1, 2))
        is_chained[1:] = same & (episode[1:] == episode[:-1])

    def pad(array, fill=0):
        width = [(0, capacity - num_rows)] + [(0, 0)] * (array.ndim - 1)
        return np.pad(array, width, constant_values=fill)

    return History(
        state=on_device(pad(np.nan_to_num(state))),
        action=on_device(pad(action)),
        next_state=on_device(pad(np.nan_to_num(next_state))),
        dt=on_device(pad(dt, dt[0] if num_rows else 1.0)),
        episode=on_device(pad(episode, -1), np.dtype(np.int32)),
        mask=on_device(pad(np.ones(num_rows, bool)), bool),
        state_mask=on_device(pad(~np.isnan(state)), bool),
        next_state_mask=on_device(pad(~np.isnan(next_state)), bool),
        is_chained=on_device(pad(is_chained), bool),
    )


def _each_dt(dt: np.ndarray, num_rows: int) -> np.ndarray:
    """Length of each step; one that the float type takes for zero is none."""
    if dt.shape not in ((), (1,), (num_rows,)):
        raise ValueError(
            f"dt: expected one number or shape ({num_rows},), got shape {dt.shape}"
        )
    with np.errstate(over="ignore", under="ignore"):
        held = dt.astype(jax.dtypes.canonicalize_dtype(float))
    check_positive_seconds("", dt, np.isfinite(held) & (held > 0))
    return np.broadcast_to(dt, (num_rows,))


def _check_point(action: np.ndarray, point: np.ndarray, pose: np.ndarray) -> None:
    """A torque about what was not seen would be made up."""
    is_centred = np.all(np.isnan(point), axis=-1)
    is_lost = np.any(np.isnan(pose), axis=-1)
    is_lost |= ~np.all(np.isfinite(point), axis=-1)
    is_lost &= np.any(action[..., :2] != 0, axis=-1) & ~is_centred
    if np.any(is_lost):
        row, body = np.argwhere(is_lost)[0]
        raise ValueError(
            f"point: expected a pose of body {body} and both numbers of the point (or "
            f"NaN for both) wherever a force acts, got none in row {row}"
        )
