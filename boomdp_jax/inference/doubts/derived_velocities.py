r"""Velocities that were computed from the poses beside them.

Such velocities hold no news, and the filters take them for measured. What tells them
from measured ones is noise. A velocity $v_t = \sum_j c_j p_{t + j}$ that was computed
repeats the noise of the poses p exactly, whatever the weights c of a formula or filter
are. A measured one cannot: it departs from every such sum by at least $|c| s$, where s
is the sd of that noise,

- for formulas, by differences of high order over a few readings;
- for weights that were fitted, and for filters that smoothed the poses as well, of
  which $\sum_j a_j v_{t + j} = \sum_j d_j p_{t + j}$ holds, by the least of all sums
  over more readings than have weights.

Poses without noise have in its place what no law predicts, as of pushes. Where neither
is, as of constant speeds and free swings in exact simulations, s is rounding, and
nothing is said.
"""

from collections.abc import Iterator, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from boomdp_jax.core.history import History
from boomdp_jax.inference.readings.pose_steps import ANGLES, POSITIONS, Steps, steps_of
from boomdp_jax.physics.scene_spec import SceneSpec

# Share of |c| s that velocities have to depart from a sum of poses by.
_LEAST_SHARE = 0.3
# Noise that is less than this share of how far a body goes over a window is rounding.
_ROUNDING = 1e-7
# Share of windows that may have less of it than is counted on.
_QUANTILE = 0.25
# Rates that a sum of poses has to be of, as shares of theirs.
_LEAST_GAIN, _MOST_GAIN = 0.7, 1.3
# Readings to either side that a sum is fitted over, and how many more noise is.
_REACHES, _BEYOND = (1, 2, 3, 4, 5, 6, 8), 2
# Where a row is five to eight steps of a simulator, and nothing has noise, sums over
# so many follow velocities as well: shares of those count as so many times as large.
_FAR, _TIMES_FAR = 7, 3.0
# Equations for each weight that is fitted.
_EACH = 3
# Order of differences that are noise.
_ORDER = 6
# Filters of polynomials: windows, and orders that differ in smoothing or in slope.
_WINDOWS, _ORDERS = (5, 7, 9, 11, 13, 15, 17, 19, 21), (2, 3, 4)
# Steps whose lengths differ by no more than this share of themselves are even.
_EVEN = 1e-3
# More rows tell no more.
_MOST_ROWS = 600
_TWIST = {"positions": "velocities", "angles": "angular velocities"}


def derived_velocity_reasons(
    spec: SceneSpec, history: History, named: Sequence[str] = ()
) -> list[str]:
    """Reasons for doubt about velocities that were computed from the poses.

    Late ones (`pose_velocity_reasons`) are not all: those of np.gradient, from poses
    with noise of 1 mm and pushes held for five rows of 50 ms, made one of twelve free
    boxes out to lie on a rough floor, without a doubt, and masses up to three times as
    large with new pushes in each row; the same poses alone gave masses to 0.1 %.

    Right recordings (free and dry boxes, drag, springs, pendulums, double ones, discs
    that go round fast, wheels, drawers, walls, smooth reaches and rest; 12 to 200 rows
    of 5 to 50 ms, of even lengths or not; read exactly, or with noise of which that of
    poses or of velocities is up to a thousand times as large; in single precision or
    four digits): none of 11,520 was named, 7,800 of them with rows enough to tell, nor
    of 1,725 of this engine's random worlds and of MuJoCo's objects. The least share of
    the 7,800 was twice what is asked for.

    With noise of 0.2 or 1 mm and 80 rows of 20 or 50 ms (free, on a rod, on a wheel, in
    a drawer) all of 36 each were named that came from np.gradient, differences forward,
    a cubic spline, or filters of parabolas or cubics over 5, 7 or 11 readings, with
    poses as read or smoothed by the same; so were those of 40 rows, but for poses that
    were smoothed over 11. In 20 rows differences and filters over 5 are seen. Of files
    with four digits filters that smoothed the poses too are mostly missed, as are those
    that feed back over long spans both ways (Butterworth) where poses are as read.
    Poses that were summed from velocities look the same as velocities from differences;
    by the trapezoidal rule they are not seen.

    Args:
        spec: the scene, for names.
        history: its readings.
        named: lines of `pose_velocity_reasons`; bodies that these are about are passed
            over.

    Returns:
        One line for each body of which there are such velocities.
    """
    reasons = []
    for body in np.flatnonzero(~np.asarray(spec.is_static)):
        name = spec.names[body]
        if any(line.startswith(f"{name}: ") for line in named):
            continue
        steps = [steps_of(history, int(body), *part) for part in (POSITIONS, ANGLES)]
        found = [each.what for each in steps if _least_share(each) < _LEAST_SHARE]
        if found:
            twists = " and ".join(_TWIST[what] for what in found)
            reasons.append(
                f"{name}: {twists} repeat the noise of {' and '.join(found)}, as what "
                "is computed from them does (np.gradient, a smoothing filter); "
                "expected velocities measured at the reading's instant: leave "
                "velocities out (NaN)"
            )
    return reasons


def _least_share(steps: Steps) -> float:
    """How far velocities are from the nearest sum of poses, in sds of its noise.

    Args:
        steps: readings of positions or of angles.

    Returns:
        About one or more where velocities were measured; infinite: cannot be told.
    """
    tracks = list(_tracks(steps))
    even = [part for track in tracks for part in _even(track)]
    shares = [*_of_formulas(tracks), *_of_fits(even), *_of_filters(even)]
    return min(shares, default=np.inf)


class _Track(NamedTuple):
    """Readings on end."""

    pose: Float[np.ndarray, "instant part"]
    """From where it starts [m] or [rad]."""
    twist: Float[np.ndarray, "instant part"]
    """[m/s] or [rad/s]."""
    dt: Float[np.ndarray, " row"]
    """[s]."""


def _tracks(steps: Steps) -> Iterator[_Track]:
    """Rows that follow each other."""
    run = steps.run[:_MOST_ROWS]
    for rows in np.split(np.arange(len(run)), np.flatnonzero(np.diff(run)) + 1):
        if len(rows):
            moved = np.cumsum(steps.rate[rows] * steps.dt[rows, None], axis=0)
            yield _Track(
                np.concatenate([np.zeros_like(moved[:1]), moved]),
                np.concatenate([steps.first[rows], steps.last[rows[-1:]]]),
                steps.dt[rows],
            )


def _even(track: _Track) -> Iterator[_Track]:
    """Parts of a track whose steps are of one length."""
    changes = np.abs(np.diff(track.dt)) > _EVEN * track.dt[1:]
    for rows in np.split(np.arange(len(track.dt)), np.flatnonzero(changes) + 1):
        ends = slice(rows[0], rows[-1] + 2)
        yield _Track(track.pose[ends], track.twist[ends], track.dt[rows])


def _inner(track: _Track, ends: int) -> _Track:
    """A track of even steps without so many readings at either end."""
    some = slice(ends, -ends)
    return _Track(track.pose[some], track.twist[some], track.dt[2 * ends :])


def _num_parts(tracks: list[_Track]) -> int:
    """Directions in which a body moves: of a drawer, one of two."""
    pose = np.concatenate([track.pose - track.pose.mean(axis=0) for track in tracks])
    size = np.linalg.svd(pose, compute_uv=False)
    return max(int(np.sum(size > _ROUNDING * size[0])), 1) if len(size) else 1


def _windows(values: np.ndarray, length: int) -> np.ndarray:
    """Values `[instant, ...]` of so many instants on end, `[window, length, ...]`."""
    if len(values) < length:
        return np.zeros((0, length, *values.shape[1:]))
    view = np.lib.stride_tricks.sliding_window_view(values, length, axis=0)
    return np.moveaxis(view, -1, 1)


def _slid(weight: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Sums of values `[instant, part]` on end."""
    return np.einsum("j,wjp->wp", weight, _windows(values, len(weight)))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0


def _usual(values: Float[np.ndarray, "window part"], num_parts: int) -> float:
    """What most windows exceed: a few impacts are no noise."""
    size = np.sqrt(np.sum(values**2, axis=1) / num_parts)
    return float(np.quantile(size, _QUANTILE))


def _of_formulas(tracks: list[_Track]) -> Iterator[float]:
    """Shares of differences forward, and of slopes over both neighbours."""
    noise, size, rest = [], [], []
    for track in tracks:
        if len(track.dt) <= _ORDER:
            continue
        time = np.append(0.0, np.cumsum(track.dt)) / np.median(track.dt)
        weight = _difference_weights(_windows(time, _ORDER + 1))
        pose = _windows(track.pose, _ORDER + 1)
        noise.append(np.einsum("wj,wjp->wp", weight, pose))
        size.append(np.diff(pose, axis=1))
        before, after = track.dt[:-1], track.dt[1:]
        both, zero = before + after, 0.0 * before
        pose, twist = _windows(track.pose, 3), track.twist[1:-1]
        rest.append([])
        for weight in (
            [zero, -1.0 / after, 1.0 / after],
            [-1.0 / both, zero, 1.0 / both],
            [
                -after / (before * both),
                (after - before) / (before * after),
                before / (after * both),
            ],
        ):
            norm = np.linalg.norm(weight, axis=0)[:, None]
            made = np.einsum("jw,wjp->wp", np.array(weight), pose)
            rest[-1].append((twist - made) / norm)
    num_parts = _num_parts(tracks) if noise else 1
    least = _noise(tracks, _ORDER // 2, num_parts) if noise else None
    if least is None:
        return
    # Noise that alternates, as rounding may, is less in some sums than in others.
    sd = min(_usual(np.concatenate(noise), num_parts), least)
    if sd > _ROUNDING * _rms(np.concatenate(size)):
        for each in zip(*rest, strict=True):
            yield _rms(np.concatenate(each)) / sd


def _difference_weights(
    time: Float[np.ndarray, "window reading"],
) -> Float[np.ndarray, "window reading"]:
    """Weights of length one of which polynomials of lower order leave nothing."""
    apart = time[:, :, None] - time[:, None, :]
    weight = 1.0 / np.prod(apart + np.eye(time.shape[1]), axis=2)
    return weight / np.linalg.norm(weight, axis=1, keepdims=True)


def _of_fits(tracks: list[_Track]) -> Iterator[float]:
    """Shares of weights that fit best."""
    if not tracks:
        return
    num_parts = _num_parts(tracks)
    for reach in _REACHES:
        sd = _noise(tracks, reach + _BEYOND, num_parts)
        if sd is None:
            return
        if sd == 0.0:
            continue
        length = 2 * reach + 1
        basis = _no_sum(length)
        pose = np.concatenate([_windows(track.pose, length) for track in tracks])
        twist = np.concatenate(
            [
                track.twist[reach:-reach] * np.median(track.dt)
                for track in tracks
                if len(track.twist) >= length
            ]
        )
        reduced = np.einsum("wjp,jb->wpb", pose, basis).reshape(-1, 2 * reach)
        half = len(reduced) // 2
        rest = [
            _crossed(reduced, twist.ravel(), some, basis)
            for some in (slice(half), slice(half, None))
        ]
        times = _TIMES_FAR if reach >= _FAR else 1.0
        yield times * _rms(np.concatenate(rest)) / sd


def _crossed(pose: np.ndarray, twist: np.ndarray, some: slice, basis: np.ndarray):
    """Rest of some equations by weights that fit the others, in lengths of those."""
    is_other = np.ones(len(twist), bool)
    is_other[some] = False
    fit, *_ = np.linalg.lstsq(pose[is_other], twist[is_other], rcond=None)
    weight = basis @ fit
    place = np.arange(len(weight)) - len(weight) // 2
    rest = (twist[some] - pose[some] @ fit) / max(float(np.linalg.norm(weight)), 1e-30)
    is_rate = _LEAST_GAIN < float(place @ weight) < _MOST_GAIN
    return rest if is_rate else np.full_like(rest, np.inf)


def _of_filters(tracks: list[_Track]) -> Iterator[float]:
    """Shares of filters that fit polynomials, and smooth the poses with them too."""
    for length in _WINDOWS:
        half = length // 2
        # Those at the ends are from other polynomials.
        inner = [_inner(each, half) for each in tracks if len(each.pose) > 2 * length]
        sd = _noise(inner, half + _BEYOND, _num_parts(inner)) if inner else None
        if not sd:
            continue
        for order in _ORDERS:
            if order < length - 1:
                smooth, slope = _polynomial_weights(length, order)
                rest = [
                    _slid(smooth, track.twist) * np.median(track.dt)
                    - _slid(slope, track.pose)
                    for track in inner
                ]
                yield _rms(np.concatenate(rest)) / (float(np.linalg.norm(slope)) * sd)


def _noise(tracks: list[_Track], reach: int, num_parts: int) -> float | None:
    """Sd of what the rest of a window does not tell of poses, at least.

    Returns:
        The sd [m] or [rad], zero where it is rounding; None: too few readings.
    """
    length = 2 * reach + 1
    pose = np.concatenate([_windows(track.pose, length) for track in tracks])
    if len(pose) * num_parts < _EACH * 2 * reach:
        return None
    reduced = np.einsum("wjp,jb->wpb", pose, _no_sum(length)).reshape(-1, 2 * reach)
    _, size, ways = np.linalg.svd(np.linalg.qr(reduced, mode="r"))
    sd = _usual((reduced @ ways[-1]).reshape(len(pose), -1), num_parts)
    return 0.0 if sd * np.sqrt(len(pose)) <= _ROUNDING * size[0] else sd


@cache
def _no_sum(length: int) -> Float[np.ndarray, "length less"]:
    """A basis, orthonormal, of weights whose sum is zero."""
    columns = np.column_stack([np.ones(length), np.eye(length)[:, :-1]])
    return np.linalg.qr(columns)[0][:, 1:]


@cache
def _polynomial_weights(length: int, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Weights for the value and the slope amid readings that a polynomial fits."""
    place = np.arange(length) - length // 2
    fit = np.linalg.pinv(np.vander(place.astype(float), order + 1, increasing=True))
    return fit[0], fit[1]
