r"""Whether a thing is held back at the ends of its way by more than what moves it.

What pushes, drags and springs do is fitted where no reading is near either end; at the
ends it should go by them too. What a stop takes away points inwards, each time, and is
far more than is left anywhere else. What is left is in units of its standard error:
that of the readings, whichever were made, and of what was fitted.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from boomdp_jax.inference.doubts.places_nearby import places_nearby
from boomdp_jax.inference.doubts.stretches import (
    Fit,
    Readings,
    Stretches,
    changes_of,
    cut,
    fit_of,
    readings_of,
    step_of,
)
from boomdp_jax.inference.doubts.told_by_channels import between
from boomdp_jax.inference.doubts.way_of_body import Way, whole_places

# So many readings before and after tell of a change: a push shows by the square of
# that, and what a fit does not know of does as well.
_BESIDE = (2, 4, 8, 12)
# An end is as far from the outermost reading as so many times the noise, and this share
# of the way.
_NOISES, _SHARE = 3.0, 0.02
# Degrees of freedom of what is fitted, and changes elsewhere to compare with.
_FEWEST_FREE, _FEWEST_INNER = 12, 10
# In units of what is left elsewhere: what counts as held back, of so many at least; the
# most that one counts, and what the mean of all at the ends is in its standard errors.
_HELD, _FEWEST_HELD, _MOST, _LEAST = 5.0, 3, 8.0, 7.0
# Of so many held back, at most one may be pushed on, and the share of those far off
# elsewhere is so many times less.
_TIMES = 4.0
# Once will do if it is so much, and nothing like it is at so many places elsewhere.
_ONCE, _FEWEST_CALM = 15.0, 20
# Readings within so many times their noise are of a thing at rest, over a few before
# and after; that takes away what is beyond so many of its standard errors.
_STILL, _FEW, _SURE = 6.0, 4, 2.0
# A spring may do so many times what pushes do, where these swing it.
_SWINGS = 3.0
_MEDIAN = 0.6745
_TINY = np.finfo(float).tiny


class _Look(NamedTuple):
    """A way, and where in it something is looked for."""

    way: Way
    readings: Readings
    end: Int[np.ndarray, " reading"]
    """One at the upper end, minus one at the lower, two at both, zero between."""
    is_still: Bool[np.ndarray, " reading"]
    likely: Float[np.ndarray, " number"]
    """Standard deviations, beforehand, of what is fitted."""


class _Left(NamedTuple):
    """Changes of speed that what moves it does not explain."""

    change: Float[np.ndarray, " stretch"]
    error: Float[np.ndarray, " stretch"]
    give: Float[np.ndarray, " stretch"]
    """By how much a unit of friction may change the speed either way."""
    side: Int[np.ndarray, " stretch"]


def is_held_back(way: Way) -> bool:
    """Whether it is, by what some number of readings about each tells."""
    place, ahead, behind = places_nearby(way)
    place = between(np.where(np.isnan(place), way.place, place), way.run, way.time)
    if not np.isfinite(place).any():
        return False
    # Of runs in which no place was read nothing is said by the places made up here.
    place = np.where(np.isfinite(place), place, np.nanmean(place))
    readings = readings_of(way, place)
    # A bounce may lie between two readings.
    is_high, is_low = near_ends(way, np.stack([way.place, place, ahead, behind]))
    end = np.where(is_high & is_low, 2, is_high.astype(int) - is_low)
    is_still = _still(way, place)
    likely = _likely(way, readings, place, (end == 0) & ~is_still)
    if likely is None:
        return False
    look = _Look(way, readings, end, is_still, likely)
    return any(_tells_a_stop(look, beside) for beside in _BESIDE)


def near_ends(
    way: Way, places: Float[np.ndarray, "some place"]
) -> tuple[np.ndarray, np.ndarray]:
    """Whether some of each few places come near the upper, and the lower end.

    Args:
        way: of which these are the ends.
        places: NaN is near neither.
    """
    whole = whole_places(way)
    low, high = np.nanmin(whole), np.nanmax(whole)
    near = _NOISES * way.noise + _SHARE * (high - low)
    is_high, is_low = places > high - near, places < low + near
    return np.any(is_high, axis=0), np.any(is_low, axis=0)


def _still(way: Way, place: np.ndarray) -> Bool[np.ndarray, " reading"]:
    """Readings about which it rests, over a few before and after in the same run."""
    at = np.arange(len(place))[:, None] + np.arange(-_FEW, _FEW + 1)
    own = np.clip(at, 0, len(place) - 1)
    is_near = (at == own) & (way.run[own] == way.run[:, None])
    most = np.where(is_near, place[own], -np.inf).max(axis=1)
    least = np.where(is_near, place[own], np.inf).min(axis=1)
    return (most - least < _STILL * way.noise) & (is_near.sum(axis=1) > _FEW)


def _likely(
    way: Way, readings: Readings, place: np.ndarray, is_inner: np.ndarray
) -> np.ndarray | None:
    """Standard deviations, beforehand, of what is fitted: drags by what pushes do.

    What is pushed goes on against what drags it; of pushes nothing is known.
    """
    if not is_inner.any():
        return None
    fit = fit_of(readings, cut(is_inner, way.run, 2 * _BESIDE[2] + 1))
    if fit is None:
        return None
    push = np.sqrt(np.mean((way.force @ fit.found) ** 2)) + _TINY
    step = np.diff(way.time)
    goes_on = (np.diff(way.run) == 0) & (step > 0.0)
    speed = np.sqrt(np.mean((np.diff(place)[goes_on] / step[goes_on]) ** 2))
    forces = np.full(way.force.shape[1], np.inf)
    spring = _SWINGS * push / (np.std(place) + _TINY)
    return np.array([push / (speed + _TINY), *forces, push, spring])


def _tells_a_stop(look: _Look, beside: int) -> bool:
    """Whether changes at the ends are held back, and others are not."""
    end, run = look.end, look.way.run
    is_inner = (end == 0) & ~look.is_still
    is_rest = (end == 0) & look.is_still
    fit = fit_of(look.readings, cut(is_inner, run, 2 * beside + 1), look.likely)
    if fit is None or fit.num_free < _FEWEST_FREE:
        return False
    stays = [cut(end == side, run, beside) for side in (-1, 1)]
    about = Stretches(*(np.concatenate(each) for each in zip(*stays, strict=True)))
    inner = np.flatnonzero(is_inner)
    own = _left(look, fit, Stretches(inner, inner), end[inner], beside)
    held = _left(look, fit, about, end[about.first], beside)
    if len(own.change) < _FEWEST_INNER or not len(held.change):
        return False
    # More is left where what moves it is not quite what was fitted.
    more = max(np.median(np.abs(own.change) / own.error) / _MEDIAN, 1.0)
    # Friction may hold whichever way it is pushed, by as much as it drags, and by as
    # much as it takes away where it rests between the ends. Of what mostly goes one
    # way it looks like a steady force.
    is_steady = np.all(look.way.force == 1.0, axis=0)
    steady = np.abs(fit.found[1:-2][is_steady])
    drag = max(np.abs(fit.found[-2]), np.max(steady, initial=0.0))
    rest = cut(is_rest, run, beside)
    rests = _left(look, fit, rest, np.zeros(len(rest.first), int), beside)
    holds = (np.abs(rests.change) - _SURE * rests.error) / rests.give
    hold = max(np.max(holds, initial=0.0), drag, fit.most_dry)

    def inward(left: _Left, friction: float) -> np.ndarray:
        free = np.maximum(np.abs(left.change) - friction * left.give, 0.0)
        return (
            -np.where(left.side > 0, 1.0, -1.0)
            * np.sign(left.change)
            * free
            / (more * left.error)
        )

    at_end, elsewhere = inward(held, hold + drag), np.abs(inward(own, hold + drag))
    # A reading that is far off looks as if held back once, and pushed on before and
    # after.
    next_to = inward(_left(look, fit, *_next_to(about, run, end), beside), 0.0)
    num_held = np.sum(at_end > _HELD)
    num_pushed = np.sum(at_end < -_HELD) + np.sum(next_to < -_HELD)
    mean = np.clip(at_end, -_MOST, _MOST).sum() / np.sqrt(len(at_end))
    is_often = (
        num_held >= max(_FEWEST_HELD, _TIMES * num_pushed)
        and num_held / len(at_end) > _TIMES * np.mean(elsewhere > _HELD)
        and mean > _LEAST
    )
    # Friction hardly shows where a thing mostly rests.
    once = _ONCE * max(1.0, look.is_still.sum() / is_inner.sum())
    is_once = at_end.max() > once and num_pushed == 0 and elsewhere.max() < _HELD
    is_once &= len(elsewhere) >= _FEWEST_CALM
    return bool(is_often or is_once)


def _left(
    look: _Look, fit: Fit, about: Stretches, side: np.ndarray, beside: int
) -> _Left:
    """What is left of changes of speed about some readings, where they are told.

    Readings before and after are of the same run, and not near the other end.
    """
    if not len(about.first):
        return _Left(*np.zeros((3, 0)), np.zeros(0, int))
    at, num = np.arange(len(look.end)), len(look.end)
    first, last = about.first.copy(), about.last.copy()
    is_new = np.append(True, look.way.run[1:] != look.way.run[:-1])
    for each in (-1, 0, 1):
        mine = side == each
        is_out = (look.end != 0) & (look.end != each)
        low = np.where(is_out, at + 1, np.where(is_new, at, 0))
        is_last = np.append(is_new[1:], True)
        high = np.where(is_out, at - 1, np.where(is_last, at, num))
        low = np.maximum.accumulate(low)
        high = np.minimum.accumulate(high[::-1])[::-1]
        first[mine] = np.maximum(first[mine] - beside, low[first[mine]])
        last[mine] = np.minimum(last[mine] + beside, high[last[mine]])
    changes = changes_of(look.readings, Stretches(first, last), about, fit.scale)
    left = changes.change - changes.reasons @ fit.found
    spread = np.einsum("si,ij,sj->s", changes.reasons, fit.covariance, changes.reasons)
    time = look.way.time
    give = time[about.last] - time[about.first] + step_of(time)
    # It may hold all the while that is looked at.
    give = np.maximum(give, np.abs(changes.even))
    is_told = np.isfinite(changes.error)
    error = np.sqrt(changes.error**2 + spread)
    return _Left(left[is_told], error[is_told], give[is_told], side[is_told])


def _next_to(
    about: Stretches, run: np.ndarray, end: np.ndarray
) -> tuple[Stretches, np.ndarray]:
    """Readings just before and after those at an end, and which end that is."""
    stay = np.concatenate([about.first, about.last])
    at = np.concatenate([about.first - 1, about.last + 1])
    own = np.clip(at, 0, len(run) - 1)
    use = (own == at) & (run[own] == run[stay]) & (end[own] == 0)
    return Stretches(at[use], at[use]), end[stay][use]
