"""What predictions start from: whole readings, or all that was read until then.

Where every channel is read, one reading says where a body is and how fast it moves.
Where some never are, as velocities by a camera, it takes the readings before: each
hypothesis is filtered along the recording, and what it then holds probable of the state
is drawn from.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.core.arrays import Key, on_device
from boomdp_jax.core.history import History
from boomdp_jax.core.quick_compile import KeptJit
from boomdp_jax.inference.hypotheses.contact_prediction import ContactScene
from boomdp_jax.inference.hypotheses.whole_motion import whole_scene
from boomdp_jax.inference.likelihoods.kalman import (
    Estimate,
    NoiseLevel,
    RowFilter,
    principal_axes,
)
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.inference.readings.touching import find_touching
from boomdp_jax.inference.readings.track_data import TrackData, track_data, with_delay
from boomdp_jax.physics import Params, Scene
from boomdp_jax.physics.scene_spec import SceneSpec

STARTS = ("auto", "readings", "filtered")
"""What predictions may start from; `auto`: readings, where any is whole."""

# Parts the noise of starts from that of what follows.
_STARTS_KEY = 1
# Hypotheses that are filtered together.
_AT_ONCE = 8
# Noise of where walls are taken to be [m, rad, m/s, rad/s].
_WALL_NOISE = 1e-5
_PARTS = ("", "_mask")
# Readings of a pose that say how fast it changes.
_ENOUGH = 2


class Carried(NamedTuple):
    """Poses as last read before each row, or at its start, and how they changed."""

    pose: Float[np.ndarray, "time body 3"]
    """NaN where a run has not shown it yet."""
    age: Float[np.ndarray, "time body 3"]
    """Since then [s]."""
    rate: Float[np.ndarray, "time body 3"]
    """Between the last two readings [m/s, m/s, rad/s]; NaN before the second."""
    num: Int[np.ndarray, "time body 3"]
    """At how many instants of the run it was read until then."""


def with_walls(spec: SceneSpec, history: History) -> History:
    """Readings with static bodies where the scene puts them, read or not.

    Likelihoods have them there; a wall that might be elsewhere would move what it hits.

    Args:
        spec: the scene.
        history: its readings.
    """
    stands = _stands(spec)
    if not stands.any():
        return history
    pose = np.concatenate([spec.pose, np.zeros_like(spec.pose)], axis=-1)
    filled: dict[str, Array] = {}
    for name in ("state", "next_state"):
        values, seen = (np.array(getattr(history, f"{name}{end}")) for end in _PARTS)
        values[:, stands], seen[:, stands] = pose[stands], True
        filled[name] = on_device(values)
        filled[f"{name}_mask"] = on_device(seen, bool)
    return dataclasses.replace(history, **filled)


def _stands(spec: SceneSpec) -> Bool[np.ndarray, " body"]:
    """Static bodies whose pose the scene gives."""
    return np.asarray(spec.is_static) & np.all(np.isfinite(spec.pose), axis=-1)


class PredictionStarts:
    """The rows of a history that may be predicted from, and the states there."""

    def __init__(self, which: str, key: Key, posterior: Posterior, history: History):
        """Filter, where that is asked for or has to be.

        Args:
            which: one of `STARTS`.
            key: random key.
            posterior: whose draws count alike.
            history: the table.

        Raises:
            ValueError: none of `STARTS`.
        """
        if which not in STARTS:
            raise ValueError(
                f"starts: expected one of {', '.join(STARTS)}; got {which!r}"
            )
        self._history = jax.tree.map(np.asarray, history)
        self._is_static = np.asarray(posterior.spec.scene.is_static)
        self._carried: Carried | None = None
        self.state: Float[Array, "draw time body 6"] | None = None
        """True states, draw by draw; None: predictions start from readings."""
        if which == "auto":
            which = "readings" if len(self.rows(1)) else "filtered"
        self.name = which
        """`readings` or `filtered`."""
        if which == "filtered":
            self._carried = carried_readings(self._history)
            key = jax.random.fold_in(key, _STARTS_KEY)
            self.state = filtered_starts(key, posterior, history, self._carried)

    def rows(self, horizon: int) -> Int[np.ndarray, " start"]:
        """Those that are followed by enough rows, ascending.

        Args:
            horizon: rows needed, the start's own included.
        """
        if self._carried is None:
            return usable_starts(self._history, horizon, self._is_static)
        return followed_starts(self._history, horizon, self._is_static, self._carried)

    def baseline(self, horizon: int) -> Float[np.ndarray, "time body 6"]:
        """What is read after so many steps if bodies go on as they were read.

        Args:
            horizon: steps ahead.
        """
        if self._carried is None:
            return constant_velocity(self._history, horizon)
        return last_velocity(self._history, horizon, self._carried)


def usable_starts(
    history: History, horizon: int, is_static: Bool[np.ndarray, " body"]
) -> Int[np.ndarray, " start"]:
    """Rows with a complete reading and enough rows of their episode to follow.

    Args:
        history: the table.
        horizon: rows needed, the start's own included.
        is_static: bodies whose readings do not matter.

    Returns:
        Indices of rows, ascending.
    """
    is_whole = np.all(np.asarray(history.state_mask)[:, ~is_static], axis=(1, 2))
    return _with_enough_rows(history, horizon, is_whole)


def followed_starts(
    history: History,
    horizon: int,
    is_static: Bool[np.ndarray, " body"],
    carried: Carried,
) -> Int[np.ndarray, " start"]:
    """Rows that a filter has something to say of, and enough rows to follow.

    Those before which, or at which, every pose that the history has was read twice in
    the same episode. Positions it must have.

    Args:
        history: the table.
        horizon: rows needed, the start's own included.
        is_static: bodies whose readings do not matter.
        carried: of the same history.

    Returns:
        Indices of rows, ascending.
    """
    is_there = np.asarray(history.state_mask) | np.asarray(history.next_state_mask)
    is_there = is_there & np.asarray(history.mask)[:, None, None]
    is_asked = np.any(is_there[..., :3], axis=0)
    is_asked[:, :2] = True
    is_asked[is_static] = False
    is_known = np.all((carried.num >= _ENOUGH) | ~is_asked, axis=(1, 2))
    return _with_enough_rows(history, horizon, is_known)


def _with_enough_rows(
    history: History, horizon: int, is_known: np.ndarray
) -> Int[np.ndarray, " start"]:
    mask, episode = np.asarray(history.mask), np.asarray(history.episode)
    num_starts = len(mask) - horizon + 1
    if num_starts < 1:
        return np.zeros(0, int)
    is_usable = np.array(is_known[:num_starts])
    for offset in range(horizon):
        end = offset + num_starts
        is_usable &= mask[offset:end] & (episode[offset:end] == episode[:num_starts])
    return np.flatnonzero(is_usable)


def constant_velocity(
    history: History, horizon: int
) -> Float[np.ndarray, "time body 6"]:
    """Predict from every row that bodies go on as they were read.

    Args:
        history: the table.
        horizon: steps ahead.

    Returns:
        Readings after so many steps; past the end of the table, whatever.
    """
    state = np.asarray(history.state, np.float64)
    elapsed = _elapsed(history, horizon)[:, None, None]
    pose = state[..., :3] + elapsed * state[..., 3:]
    return np.concatenate([pose, state[..., 3:]], axis=-1)


def last_velocity(
    history: History, horizon: int, carried: Carried
) -> Float[np.ndarray, "time body 6"]:
    """Predict from every row that poses go on as between their last two readings.

    Velocities that were read at the row count instead.

    Args:
        history: the table.
        horizon: steps ahead.
        carried: of the same history.

    Returns:
        Readings after so many steps; NaN where a pose was not read twice.
    """
    state = np.asarray(history.state, np.float64)
    is_read = np.asarray(history.state_mask)[..., 3:]
    rate = np.where(is_read, state[..., 3:], carried.rate)
    elapsed = _elapsed(history, horizon)[:, None, None]
    pose = carried.pose + (carried.age + elapsed) * rate
    return np.concatenate([pose, rate], axis=-1)


def _elapsed(history: History, horizon: int) -> Float[np.ndarray, " time"]:
    dt = np.asarray(history.dt, np.float64)
    time = np.concatenate([[0.0], np.cumsum(dt)])
    rows = np.arange(len(dt))
    return time[np.minimum(rows + horizon, len(dt))] - time[rows]


def carried_readings(history: History) -> Carried:
    """Carry poses on from reading to reading, run by run.

    Args:
        history: the table, without a batch axis.

    Returns:
        What was read of poses until each row.
    """
    mask, episode = np.asarray(history.mask), np.asarray(history.episode)
    dt = np.asarray(history.dt, np.float64)
    num_rows, num_bodies = np.asarray(history.state).shape[:2]
    shape = (num_bodies, 3)
    nowhere = np.full(shape, np.nan)
    out = Carried(*(np.zeros((num_rows, *shape)) for _ in Carried._fields))
    out = out._replace(num=np.zeros((num_rows, *shape), int))
    pose = rate = at = nowhere
    num, time = np.zeros(shape, int), 0.0

    def read(value, is_read):
        nonlocal pose, rate, at, num
        value = np.asarray(value, np.float64)[:, :3]
        is_read = np.asarray(is_read)[:, :3]
        is_later = is_read & (num > 0) & (time > at)
        lapse = np.where(is_later, time - at, 1.0)
        rate = np.where(is_later, (value - pose) / lapse, rate)
        num = num + (is_later | (is_read & (num == 0)))
        pose, at = np.where(is_read, value, pose), np.where(is_read, time, at)

    for row in range(num_rows):
        if row == 0 or not (mask[row - 1] and episode[row] == episode[row - 1]):
            pose = rate = at = nowhere
            num, time = np.zeros(shape, int), 0.0
        if not mask[row]:
            continue
        read(history.state[row], history.state_mask[row])
        out.pose[row], out.age[row], out.rate[row] = pose, time - at, rate
        out.num[row] = num
        time += dt[row]
        read(history.next_state[row], history.next_state_mask[row])
    return out


def filtered_starts(
    key: Key, posterior: Posterior, history: History, carried: Carried
) -> Float[Array, "draw time body 6"]:
    """Draw where bodies are at the start of each row, and how fast, by each hypothesis.

    Args:
        key: random key.
        posterior: whose draws count alike.
        history: readings; those of a row's start and all before in its episode count.
        carried: of the same history.

    Returns:
        One true state of every row for each draw. Angles are within half a turn of
        those last read; static bodies are where the row has them.
    """
    bodies = tuple(range(history.num_bodies))
    spec, world = posterior.spec, whole_scene(posterior.spec)
    reading = posterior.noise_scale
    if world.contact is not None:
        is_known = _stands(spec)[:, None]
        reading = jnp.where(is_known, _WALL_NOISE, reading)
    mask, dt = np.asarray(history.mask), np.asarray(history.dt)
    is_uniform = bool(np.all(dt[mask] == dt[0]))
    actuator = posterior.params.actuator
    data = track_data(
        history,
        bodies,
        is_uniform,
        has_delay=actuator is not None and actuator.delay is not None,
        freedom=posterior.degrees_of_freedom,
    )
    touching = find_touching(spec, history)
    if touching is not None:
        near = touching.near_rows(bodies, history.capacity)
        data = dataclasses.replace(data, may_touch=on_device(near, bool))
    noise = NoiseLevel(reading, _impulses(posterior))
    params = spec.with_surface(posterior.params)
    drawn = _draw_starts(key, world.filtered, params, noise, data)
    starts = np.array(drawn, np.float64)
    off = carried.pose[..., 2] - starts[..., 2]
    starts[..., 2] += 2.0 * np.pi * np.nan_to_num(np.round(off / (2.0 * np.pi)))
    is_static = np.asarray(spec.scene.is_static)
    starts[:, :, is_static] = np.asarray(history.state)[:, is_static]
    return on_device(starts, drawn.dtype)


def _impulses(posterior: Posterior) -> Float[Array, "draw body 2"]:
    if posterior.impulse_scale is not None:
        return posterior.impulse_scale
    return jnp.zeros((*posterior.noise_scale.shape[:2], 2), posterior.noise_scale.dtype)


@KeptJit
def _draw_starts(
    key: Key,
    scene: Scene | ContactScene,
    params: Params,
    noise: NoiseLevel,
    data: TrackData,
) -> Float[Array, "draw time body 6"]:
    def draw_one(inputs):
        key, params, noise = inputs
        row_filter = RowFilter(
            scene, params, data.steps.dt, noise, data.freedom, bends=True
        )
        rows = with_delay(params, data).rows

        def advance(before: Estimate, row):
            key, row = row
            start = _draw_state(key, row_filter.at_start(before, row))
            estimate, _ = row_filter(before, row)
            return estimate, start

        keys = jax.random.split(key, len(data.is_start))
        return jax.lax.scan(advance, row_filter.start(), (keys, rows))[1]

    keys = jax.random.split(key, len(noise.reading))
    return jax.lax.map(draw_one, (keys, params, noise), batch_size=_AT_ONCE)


def _draw_state(key: Key, estimate: Estimate) -> Float[Array, "body 6"]:
    """A state of a normal distribution that may know some directions for certain."""
    mean, covariance = estimate
    axes = principal_axes(covariance)
    noise = jax.random.normal(key, axes.shape[:1], axes.dtype)
    return mean + (axes @ noise).reshape(mean.shape)
