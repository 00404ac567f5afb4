r"""Drawers and doors that come against a stop, which no hypothesis knows of.

What goes along a line, or turns about a pin, has one coordinate q with
$\ddot q = f / m + \ldots$, f the force along the line or the torque about the pin. Over
three readings, between which average speeds are a and b,

$$b - a = \int w\, (f / m + c - k \dot q - d\, \mathrm{sign}\, \dot q)\, dt,$$

w rising from zero to one at the middle reading and falling back. These few numbers are
fitted, robustly, where no reading is near either end of the way. Where the thing is at
an end it should go by them too. What a stop takes away points inwards, each time, and
is far more than is left anywhere else. Taken for noise of the motion it makes masses
several times too large: it always opposes what pushes towards it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.doubts.way_of_body import Way, end_of_each, find_ways
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.physics.scene_arrays import has_contact
from boomdp_jax.physics.scene_spec import SceneSpec

# Readings that are so many apart count together: a push shows by the square of that.
_LAGS = (1, 2, 4)
# An end is as far from the outermost reading as so many times the noise, and this share
# of the way.
_NOISES, _SHARE = 3.0, 0.02
# Windows needed away from the ends, and at them.
_FEWEST_INNER, _FEWEST_AT_END = 25, 3
# In units of what is left elsewhere: what counts as held back, the most that one window
# counts, and what the mean of all at the ends has to be in its standard errors.
_HELD, _MOST, _LEAST = 5.0, 8.0, 7.0
# Of so many windows held back, at most one may be pushed on, and the share of those far
# off elsewhere is so many times less.
_TIMES = 4.0
# Once will do if it is so much, and nothing like it is anywhere else.
_ONCE = 15.0
# Readings within so many times their noise are of a thing at rest.
_STILL = 6.0
# What varies by less than this share of the most is not told by a fit.
_TOLD = 1e-6
_ROUNDS = 30
_MEDIAN = 0.6745


class _Windows(NamedTuple):
    """Changes of speed, and what would explain them."""

    change: Float[np.ndarray, " window"]
    reasons: Float[np.ndarray, "window number"]
    give: Float[np.ndarray, " window"]
    """By how much a unit of dry friction may change the speed either way."""
    is_still: Bool[np.ndarray, " window"]
    """Whether it rests there."""
    is_high: Bool[np.ndarray, " window"]
    is_low: Bool[np.ndarray, " window"]
    least: float
    """Noise of the changes by that of readings."""
    overlap: int
    """How many windows each instant is in."""


def without_stops(posterior: Posterior, history: History) -> tuple[History, list[str]]:
    """Rows in which nothing can have come against a stop at an end of its way.

    Args:
        posterior: what was inferred of all rows.
        history: all rows.

    Returns:
        The rows between the ends, to be inferred from anew, of which another episode
        begins after each gap: the same history where no body is held back. A line for
        each body that is.
    """
    is_free, notes = np.asarray(history.mask).copy(), []
    for body, way in _stopped_ways(posterior.spec, history, posterior):
        rows = np.flatnonzero(np.asarray(history.mask))
        end = end_of_each(history)
        begin = end - 1
        known = np.flatnonzero(np.isfinite(way.place))
        place = np.interp(way.time, way.time[known], way.place[known])
        came = np.where(
            begin > 0, place[begin] - place[np.maximum(begin - 1, 0)], 0.0
        ) * (way.run[begin] == way.run[np.maximum(begin - 1, 0)])
        ahead = place[begin] + came
        inside = np.stack([place[begin], place[end], ahead])
        is_high, is_low = _ends(way, inside.min(axis=0), inside.max(axis=0))
        is_near = is_high | is_low
        is_free[rows[is_near]] = False
        name, count = posterior.spec.names[body], f"{is_near.sum()} of {len(rows)}"
        notes.append(
            f"{name}: {count} rows are left out, in which it may have come against a "
            f"stop at the ends of {way.name}"
        )
    if not notes:
        return history, []
    return _only(history, is_free, _reach(posterior)), notes


def _reach(posterior: Posterior) -> float:
    """How long ago a command may have been given that is in effect [s]."""
    actuator = posterior.params.actuator
    if actuator is None or actuator.delay is None:
        return 0.0
    return float(np.max(np.asarray(actuator.delay), initial=0.0))


def _only(history: History, is_kept: np.ndarray, reach: float) -> History:
    """Some rows, of which another episode begins after each gap.

    Commands from before a gap may still be in effect after it: rows that are so near
    come first, without their readings.
    """
    kept, mask = np.flatnonzero(is_kept), np.asarray(history.mask)
    before, dt = np.asarray(history.episode), np.asarray(history.dt)
    begins = (np.diff(kept, prepend=-2) > 1) | (np.diff(before[kept], prepend=-1) != 0)
    rows, is_read, episode = [], [], []
    pieces = np.split(kept, np.flatnonzero(begins)[1:]) if len(kept) else []
    for number, run in enumerate(pieces):
        first = run[0]
        while (
            first > 0
            and mask[first - 1]
            and before[first - 1] == before[run[0]]
            and dt[first : run[0]].sum() < reach
        ):
            first -= 1
        num_unread = run[0] - first
        rows += [*range(first, run[0]), *run]
        is_read += [False] * num_unread + [True] * len(run)
        episode += [number] * (num_unread + len(run))
    index, told = np.array(rows, int), np.array(is_read, bool)
    # What a row ends at is where the next one starts.
    is_last_told = told | (np.append(told[1:], False))
    state, next_state = (
        np.where(
            np.asarray(there)[index] & use[:, None, None],
            np.asarray(values)[index],
            np.nan,
        )
        for values, there, use in (
            (history.state, history.state_mask, told),
            (history.next_state, history.next_state_mask, is_last_told),
        )
    )
    return make_history(
        state,
        np.asarray(history.action)[index],
        next_state,
        dt[index],
        episode=np.array(episode, int),
        capacity=max(history.capacity, len(index)),
    )


def end_stop_reasons(
    spec: SceneSpec, history: History, posterior: Posterior
) -> list[str]:
    """Reasons for doubt about bodies that are held back at the ends of their way.

    Args:
        spec: the scene, for names.
        history: its readings.
        posterior: what was inferred of it; says where pins are.

    Returns:
        One line for each body that goes along a line or turns about a pin, and is
        stopped at an end of that. Scenes with contact are not asked, nor what friction
        holds elsewhere.
    """
    return [
        f"{spec.names[body]}: is held back at the ends of {way.name}, as by a stop or "
        "a spring, which no hypothesis knows of; expected rows between the ends alone"
        for body, way in _stopped_ways(spec, history, posterior)
    ]


def _stopped_ways(
    spec: SceneSpec, history: History, posterior: Posterior
) -> list[tuple[int, Way]]:
    """Bodies that are held back, and the way at whose ends they are."""
    if has_contact(spec.bodies) or not np.any(np.asarray(history.mask)):
        return []
    found = []
    for body in np.flatnonzero(~np.asarray(spec.is_static)):
        ways = find_ways(spec, history, posterior, int(body))
        found += [(int(body), way) for way in ways if _is_stopped(way)][:1]
    return found


def _is_stopped(way: Way) -> bool:
    """Whether it is held back at an end, by some of the ways to look at it."""
    if not np.isfinite(way.place).any():
        return False
    still, speeds = _still(way), np.isfinite(way.speed).mean()
    by_speed = [_speed_windows(way, still)] if speeds > 0.5 else []
    by_place = [_place_windows(way, still, lag) for lag in _LAGS]
    return any(_tells_a_stop(windows) for windows in (*by_speed, *by_place))


def _still(way: Way) -> Bool[np.ndarray, " reading"]:
    """Readings about which it rests, over a few before and after in the same run."""
    known = np.flatnonzero(np.isfinite(way.place))
    run, q = way.run[known], way.place[known]
    out = np.zeros(len(way.place), bool)
    for each in np.unique(run):
        mine = np.flatnonzero(run == each)
        for i in mine:
            near = q[max(i - _LAGS[-1], mine[0]) : min(i + _LAGS[-1], mine[-1]) + 1]
            is_told = len(near) > _LAGS[-1]
            out[known[i]] = is_told and np.ptp(near) < _STILL * way.noise
    return out


def _ends(way: Way, least: np.ndarray, most: np.ndarray) -> tuple:
    """Whether places in windows come near the upper and the lower end."""
    low, high = np.nanmin(way.place), np.nanmax(way.place)
    near = _NOISES * way.noise + _SHARE * (high - low)
    return most > high - near, least < low + near


def _sums(way: Way) -> tuple[np.ndarray, np.ndarray]:
    """From the beginning to each reading, of forces, and of forces times their time."""
    length = np.diff(way.time, append=way.time[-1:])[:, None]
    middle = way.time[:, None] + 0.5 * length
    zero = np.zeros((1, way.force.shape[1]))
    whole = np.cumsum(way.force * length, axis=0)
    moment = np.cumsum(way.force * length * middle, axis=0)
    return np.concatenate([zero, whole])[:-1], np.concatenate([zero, moment])[:-1]


def _place_windows(way: Way, still: np.ndarray, lag: int) -> _Windows:
    """Of three places each, so many readings apart."""
    known = np.flatnonzero(np.isfinite(way.place))
    run = way.run[known]
    middle = np.arange(lag, len(known) - lag)
    middle = middle[run[middle - lag] == run[middle + lag]]
    a, b, c = (known[middle + offset] for offset in (-lag, 0, lag))
    q, t = way.place, way.time
    before, after = t[b] - t[a], t[c] - t[b]
    came, goes = (q[b] - q[a]) / before, (q[c] - q[b]) / after
    whole, moment = _sums(way)
    rises = moment[b] - moment[a] - t[a][:, None] * (whole[b] - whole[a])
    falls = t[c][:, None] * (whole[c] - whole[b]) - moment[c] + moment[b]
    pushes = rises / before[:, None] + falls / after[:, None]
    inside = q[known][middle[:, None] + np.arange(-lag, lag + 1)]
    # Where it would be one reading on: a bounce may lie between two readings.
    ahead = q[b] + came * after / lag
    least = np.minimum(inside.min(axis=1), ahead)
    most = np.maximum(inside.max(axis=1), ahead)
    is_high, is_low = _ends(way, least, most)
    step = float(np.median(np.concatenate([before, after]))) if len(middle) else 1.0
    return _windows(
        goes - came,
        pushes,
        0.5 * (came + goes),
        0.5 * (before + after),
        still[b],
        (is_high, is_low),
        0.5 * np.sqrt(6.0) * way.noise / step,
        lag,
    )


def _speed_windows(way: Way, still: np.ndarray) -> _Windows:
    """Of speeds read at two instants, one after the other."""
    known = np.flatnonzero(np.isfinite(way.place) & np.isfinite(way.speed))
    is_next = way.run[known[1:]] == way.run[known[:-1]]
    a, b = known[:-1][is_next], known[1:][is_next]
    whole, _ = _sums(way)
    q, v, length = way.place, way.speed, way.time[b] - way.time[a]
    ahead = q[a] + v[a] * length
    ends = _ends(
        way,
        np.min([q[a], q[b], ahead], axis=0, initial=np.inf),
        np.max([q[a], q[b], ahead], axis=0, initial=-np.inf),
    )
    is_still = still[a] & still[b]
    speed = 0.5 * (v[a] + v[b])
    pushes = whole[b] - whole[a]
    return _windows(v[b] - v[a], pushes, speed, length, is_still, ends, 0.0, 1)


def _windows(change, pushes, speed, length, is_still, ends, least, overlap) -> _Windows:
    """Add to pushes what speeds bring about."""
    drag = np.column_stack([speed * length, np.sign(speed) * length])
    reasons = np.column_stack([pushes, drag])
    return _Windows(change, reasons, length, is_still, *ends, least, overlap)


def _tells_a_stop(windows: _Windows) -> bool:
    """Whether windows at the ends are held back, and others are not."""
    is_between = ~(windows.is_high | windows.is_low)
    is_end = windows.is_high ^ windows.is_low
    is_inner = is_between & ~windows.is_still
    num, numbers = is_inner.sum(), windows.reasons.shape[1]
    if num < max(_FEWEST_INNER, 2 * numbers) or is_end.sum() < _FEWEST_AT_END:
        return False
    size = _sizes(windows.reasons[is_inner], windows.reasons)
    reasons = windows.reasons / size
    found = _fit(reasons[is_inner], windows.change[is_inner])
    left = windows.change - reasons @ found
    spread = np.median(np.abs(left[is_inner])) / _MEDIAN
    spread *= np.sqrt(num / (num - numbers))
    spread = max(spread, windows.least, np.finfo(float).tiny)
    # Where pushes are unlike those elsewhere, less is known of what they do.
    spread = spread * np.sqrt(1.0 + _variance(reasons[is_inner], reasons))
    # Friction may hold whichever way it is pushed, by as much as it drags, and by as
    # much as it is pushed where it rests between the ends.
    drag = np.abs(found[-1] / size[-1])
    rests = is_between & windows.is_still
    holds = np.abs(reasons[:, :-2] @ found[:-2]) / windows.give
    hold = max(np.max(holds[rests], initial=0.0), drag)
    free = np.maximum(np.abs(left) - (hold + drag) * windows.give, 0.0)
    inward = np.where(windows.is_high, -1.0, 1.0) * np.sign(left) * free / spread
    at_end, elsewhere = inward[is_end], np.abs(inward[is_inner])
    held, pushed = np.sum(at_end > _HELD), np.sum(at_end < -_HELD)
    mean = np.clip(at_end, -_MOST, _MOST).sum() / np.sqrt(len(at_end) * windows.overlap)
    is_often = (
        held >= max(_FEWEST_AT_END, _TIMES * pushed)
        and held / len(at_end) > _TIMES * np.mean(elsewhere > _HELD)
        and mean > _LEAST
    )
    # A reading that is far off looks so once, and pushed on before and after; friction
    # takes no more away than it and pushes do elsewhere, but hardly shows where a thing
    # mostly rests.
    most = np.max(np.abs(windows.change / spread)[is_inner])
    once = _ONCE * max(1.0, rests.sum() / num)
    is_once = at_end.max() > max(once, most) and pushed == 0
    is_once &= elsewhere.max() < _HELD and len(at_end) <= num
    return bool(is_often or is_once)


def _sizes(reasons: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Units of reasons in which what some windows tell next to nothing of is small."""
    size = np.sqrt(np.mean(reasons**2, axis=0))
    size = np.maximum(size, _TOLD * np.max(np.abs(others), axis=0, initial=0.0))
    return np.where(size > 0.0, size, 1.0)


def _variance(reasons: np.ndarray, others: np.ndarray) -> Float[np.ndarray, " other"]:
    """Of what is fitted to some windows, at others, in units of one window's."""
    _, values, directions = np.linalg.svd(reasons, full_matrices=False)
    values = np.maximum(values, _TOLD * max(values.max(), 1.0))
    return np.sum((others @ directions.T / values) ** 2, axis=1)


def _fit(reasons: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Coefficients by Huber's rule, of which what is far off says little."""
    root = np.ones(len(change))
    found = np.zeros(reasons.shape[1])
    for _ in range(_ROUNDS):
        found = np.linalg.lstsq(reasons * root[:, None], change * root, rcond=_TOLD)[0]
        left = np.abs(change - reasons @ found)
        spread = np.median(left) / _MEDIAN + np.finfo(float).tiny
        root = 1.0 / np.sqrt(np.maximum(left / spread, 1.0))
    return found
