r"""What changes the speed of a thing along its way, from whatever was read of it.

Some readings have a place q, some a speed, some both or neither, each with an error of
its own. Over a stretch of readings that follow one another,

$$q = q_0 + v_0 t + \sum_j \beta_j \iint f_j\, dt\, dt,$$

f what acts: forces, known between readings; drag by the speed, dry friction and a
spring, by where it went. The $\beta$ are fitted to stretches that each begin anywhere
and at any speed. About some readings of a stretch there is one unknown more, a change
of speed. Its estimate by least squares is a sum of readings that is zero of $q_0$ and
$v_0$; the same sum of the double integrals is what forces would have it be.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from boomdp_jax.inference.doubts.way_of_body import Way

_MEDIAN = 0.6745
_ROUNDS = 20
# Rounds in which errors are told from what is left, from so many places, or speeds, at
# least; and how much less than `scatter` has it they may be, and more.
_ERROR_ROUNDS, _FEWEST, _LESS, _MORE = 3, 10, 0.02, 10.0
# What varies by less than this share of the most is not told by a fit.
_TOLD = 1e-6
# What is left beyond so many times the spread of most says little.
_FAR = 2.0
_TINY = np.finfo(float).tiny


class Stretches(NamedTuple):
    """First and last readings of some stretches, each within a run."""

    first: Int[np.ndarray, " stretch"]
    last: Int[np.ndarray, " stretch"]


class Readings(NamedTuple):
    """Places, then speeds, and what forces of one add to them."""

    time: Float[np.ndarray, " reading"]
    run: Int[np.ndarray, " reading"]
    value: Float[np.ndarray, "2 reading"]
    """Zero where not read."""
    weight: Float[np.ndarray, "2 reading"]
    """One over the error; zero where not read."""
    reason: Float[np.ndarray, "2 reading number"]
    """Drag, pushes and what else may act, dry friction, a spring."""


class Fit(NamedTuple):
    """What moves it."""

    found: Float[np.ndarray, " number"]
    covariance: Float[np.ndarray, "number number"]
    most_dry: float
    """Dry friction that there may be [unit of acceleration]."""
    num_free: int
    """Degrees of freedom."""
    scale: Float[np.ndarray, "2"]
    """Errors of places and of speeds, by what they were taken to be."""


class Changes(NamedTuple):
    """Changes of speed about some readings, each in a stretch of its own."""

    change: Float[np.ndarray, " stretch"]
    reasons: Float[np.ndarray, "stretch number"]
    even: Float[np.ndarray, " stretch"]
    """What an acceleration of one all the while would have them be."""
    error: Float[np.ndarray, " stretch"]
    """Infinite where the readings do not tell."""


def readings_of(way: Way, place: Float[np.ndarray, " reading"]) -> Readings:
    """Readings, and what acts as double and single integrals.

    Args:
        way: the coordinate.
        place: where it was at each reading, without gaps.
    """
    length = np.diff(way.time, append=way.time[-1:])
    goes = np.diff(place, append=place[-1:])
    goes_on = np.append(way.run[1:] == way.run[:-1], False)
    length, goes = np.where(goes_on, length, 0.0), np.where(goes_on, goes, 0.0)
    middle = place + 0.5 * goes
    # Which way it goes is not told where it goes no further than by noise.
    sign = np.clip(goes / way.noise, -1.0, 1.0)
    force = np.column_stack([way.force, sign, middle - place.mean()])
    speed = _before_each(force * length[:, None])
    step = speed * length[:, None] + 0.5 * force * (length**2)[:, None]
    # A drag of one takes as much speed away as it went far.
    went = _before_each((middle * length)[:, None])
    reason = np.stack(
        [
            np.column_stack([went, _before_each(step)]),
            np.column_stack([place, speed]),
        ]
    )
    value = np.stack([way.place, way.speed])
    error = np.stack([way.place_error, way.speed_error])
    is_read = np.isfinite(value) & np.isfinite(error)
    weight = np.where(is_read, 1.0 / np.where(is_read, error, 1.0), 0.0)
    return Readings(way.time, way.run, np.where(is_read, value, 0.0), weight, reason)


def _before_each(steps: np.ndarray) -> np.ndarray:
    """Sums of those before each."""
    return np.cumsum(steps, axis=0) - steps


class _Gathered(NamedTuple):
    """Rows of places, then of speeds, of each stretch."""

    time: Float[np.ndarray, "stretch member"]
    """Since its first reading."""
    value: Float[np.ndarray, "stretch row"]
    weight: Float[np.ndarray, "stretch row"]
    reason: Float[np.ndarray, "stretch row number"]


def _gathered(readings: Readings, stretches: Stretches) -> _Gathered:
    first = stretches.first[:, None]
    width = max(int(np.max(stretches.last - stretches.first)) + 1, 3)
    at = first + np.arange(width)
    is_in = at <= stretches.last[:, None]
    at = np.minimum(at, len(readings.time) - 1)
    value, weight, reason = (
        np.concatenate([each[0][at], each[1][at]], axis=1)
        for each in (readings.value, readings.weight, readings.reason)
    )
    # Of integrals since long before, what is the same all over says nothing.
    reason[:, :width] -= readings.reason[0][first]
    time = np.where(is_in, readings.time[at] - readings.time[first], 0.0)
    return _Gathered(time, value, weight * np.tile(is_in, 2), reason)


def _rows(*pairs: tuple[np.ndarray, np.ndarray]) -> Float[np.ndarray, "s row number"]:
    """Side by side, of what adds to places and to speeds."""
    columns = [np.concatenate(pair, axis=1) for pair in pairs]
    return np.stack(columns, axis=-1)


def fit_of(
    readings: Readings,
    stretches: Stretches,
    likely: Float[np.ndarray, " number"] | None = None,
) -> Fit | None:
    """What moves it, from stretches in which nothing else does.

    Args:
        readings: of it.
        stretches: of those, one at least.
        likely: standard deviations beforehand of what forces do; None for no drags and
            no spring, of which nothing is known.

    Returns:
        None where they tell nothing.
    """
    if likely is None:
        readings = readings._replace(reason=readings.reason[..., 1:-2])
    time, value, weight, reason = _gathered(readings, stretches)
    one, none = np.ones_like(time), np.zeros_like(time)
    start = _rows((one, none), (time, one))
    everything = np.concatenate([reason, value[..., None]], axis=-1)
    is_speed = np.tile(np.arange(2) > 0, (len(time), 1)).repeat(time.shape[1], axis=1)
    scale, fit = np.ones(2), None
    for _ in range(_ERROR_ROUNDS):
        each = (weight / scale.repeat(time.shape[1]))[..., None]
        across, size = np.linalg.qr(start * each)
        left = everything * each
        left = left - across @ (across.transpose(0, 2, 1) @ left)
        # What has no speed of its own, for want of readings, has no say.
        size = np.abs(np.diagonal(size, axis1=1, axis2=2))
        is_told = size[:, 1] > _TOLD * _TOLD * size[:, 0] + _TINY
        use = (weight > 0.0) & is_told[:, None]
        num_free = use.sum() - 2 * is_told.sum() - reason.shape[-1]
        if num_free < 2:
            return None
        rows = left[use]
        found, covariance, most_dry = _moved(rows[:, :-1], rows[:, -1], likely)
        fit = Fit(found, covariance, most_dry, int(num_free), scale)
        residual = np.abs(rows[:, -1] - rows[:, :-1] @ found)
        residual *= np.sqrt(len(rows) / num_free) / _MEDIAN
        factors = [
            np.median(own) if len(own) >= _FEWEST else 1.0
            for own in (residual[~is_speed[use]], residual[is_speed[use]])
        ]
        scale = np.clip(scale * factors, _LESS, _MORE)
    return fit


def _moved(
    reasons: np.ndarray, values: np.ndarray, likely: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, float]:
    """What reasons do, with its covariance, and how much dry friction there may be.

    What drags or springs back never drives: it is none where a fit has it drive.
    """
    if likely is None:
        return *_fitted(reasons, values), 0.0
    reasons = np.concatenate([reasons, np.diag(1.0 / likely)])
    values = np.append(values, np.zeros(len(likely)))
    last = reasons.shape[1] - 1
    found, covariance = _fitted(reasons, values)
    dry = np.sqrt(covariance[last - 1, last - 1]) - found[last - 1]
    is_none = np.zeros(last + 1, bool)
    while True:
        size = np.sqrt(np.diag(covariance)) + _TINY
        drives = {
            i: found[i] / size[i]
            for i in (0, last - 1, last)
            if found[i] > 0.0 and not is_none[i]
        }
        if not drives:
            break
        is_none[max(drives, key=lambda i: drives[i])] = True
        found, covariance = _fitted(np.where(is_none, 0.0, reasons), values)
    found[is_none] = 0.0
    covariance[is_none] = 0.0
    covariance[:, is_none] = 0.0
    return found, covariance, max(dry, 0.0)


def _fitted(reasons: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients by Huber's rule, and their covariance for errors of one."""
    size = np.sqrt(np.mean(reasons**2, axis=0))
    size = np.where(size > 0.0, size, 1.0)
    reasons = reasons / size
    root, found = np.ones(len(values)), np.zeros(len(size))
    for _ in range(_ROUNDS):
        before = found
        found = np.linalg.lstsq(reasons * root[:, None], values * root, rcond=_TOLD)[0]
        left = np.abs(values - reasons @ found)
        spread = _FAR * np.median(left) / _MEDIAN + _TINY
        root = 1.0 / np.sqrt(np.maximum(left / spread, 1.0))
        if np.allclose(before, found, rtol=1e-4, atol=0.0):
            break
    _, sizes, ways = np.linalg.svd(reasons, full_matrices=False)
    sizes = np.maximum(sizes, _TOLD * max(sizes.max(), 1.0))
    covariance = (ways.T / sizes**2) @ ways
    return found / size, covariance / np.outer(size, size)


def changes_of(
    readings: Readings,
    stretches: Stretches,
    about: Stretches,
    scale: Float[np.ndarray, "2"],
) -> Changes:
    """Changes of speed about some readings, as all of a stretch have them.

    Args:
        readings: of the way.
        stretches: what the changes are told from, one at least.
        about: readings in each, from half a step before which until half a step after
            the speed changes.
        scale: errors of places and speeds by what they were taken to be.
    """
    time, value, weight, reason = _gathered(readings, stretches)
    weight = weight / scale.repeat(time.shape[1])
    origin = readings.time[stretches.first]
    half = 0.5 * step_of(readings.time)
    begin = (readings.time[about.first] - origin - half)[:, None]
    length = (readings.time[about.last] - origin + half)[:, None] - begin
    inside = np.clip(time - begin, 0.0, length)
    bend = inside**2 / (2.0 * length) + np.maximum(time - begin - length, 0.0)
    one, none = np.ones_like(time), np.zeros_like(time)
    basis = _rows((one, none), (time, one), (bend, inside / length))
    basis *= weight[..., None]
    across, size = np.linalg.qr(basis)
    sizes = size[:, 2, 2]
    is_told = np.abs(sizes) > _TOLD * np.linalg.norm(basis[..., 2], axis=1) + _TINY
    sizes = np.where(is_told, sizes, 1.0)
    pick = across[..., 2] * weight / sizes[:, None]
    even = np.concatenate([0.5 * time**2, time], axis=1)
    return Changes(
        np.sum(pick * value, axis=1),
        np.einsum("sr,srn->sn", pick, reason),
        np.sum(pick * even, axis=1),
        np.where(is_told, 1.0 / np.abs(sizes), np.inf),
    )


def step_of(time: Float[np.ndarray, " reading"]) -> float:
    """Usual time from one reading to the next [s]."""
    return max(float(np.median(np.diff(time))), _TINY)


def cut(
    use: Bool[np.ndarray, " reading"], run: Int[np.ndarray, " reading"], most: int
) -> Stretches:
    """Stretches of readings in use, of at most so many, about as long as each other."""
    begins = use & np.append(True, ~use[:-1] | (run[1:] != run[:-1]))
    ends = use & np.append(~use[1:] | (run[1:] != run[:-1]), True)
    first, last = [], []
    for a, b in zip(np.flatnonzero(begins), np.flatnonzero(ends) + 1, strict=True):
        at = np.linspace(a, b, -(-(b - a) // most) + 1).round().astype(int)
        first += [*at[:-1]]
        last += [*(at[1:] - 1)]
    return Stretches(np.array(first, int), np.array(last, int))
