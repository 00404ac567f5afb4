"""Velocities that do not say what the poses beside them say.

Over a row of length h that leads from pose p and velocity v to p' and v', the mean rate
$r = (p' - p) / h$ is the mean of v and v' but for what the push changes within the row
and for noise. Rows in which all four were read tell, without any model,

- velocities that are late: of a share c of half the row's change, $r - (v + v') / 2$ is
  as much, $c (v' - v) / 2$. Backward differences of poses have c = 1, averages over
  several of them more, and so have rows that are one step of a simulator (semi-implicit
  Euler moves a body by its new velocity). The velocities then hold no news besides the
  poses, the filters take them for exact, and masses come out hundreds of times wrong,
  or, of what turns about a pin, twice as large;
- units or steps that are not as told: r is k times the mean velocity;
- steps that are not as long as told: r departs from the mean velocity along it, by more
  the faster a body goes (a note);
- velocities that nobody read, zero in all rows.

Statistics count rows or compare medians, so that stops, impacts and gross errors in
less than half of the rows decide nothing.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from boomdp_jax.core.history import History
from boomdp_jax.inference.doubts.step_jitter import step_jitter
from boomdp_jax.inference.readings.pose_steps import (
    ANGLES,
    POSITIONS,
    SHARED,
    Steps,
    norm_of,
    pooled_sds,
    ranks_of,
    sds_of_correlation,
    steps_of,
    weighted_median,
)
from boomdp_jax.physics.scene_arrays import has_contact
from boomdp_jax.physics.scene_spec import SceneSpec

# False alarms: see `pose_velocity_reasons`. Sds of a normal number that a statistic has
# to be above, and the median share c from which velocities count as late: a simulator
# that takes four steps a row has 1/4 and masses that are up to a tenth wrong, one that
# takes eight half of that and less.
_LATE_SDS, _LEAST_LATE = 4.0, 0.2
# Bodies that touch move by their new velocities in this engine, a quarter of a row's at
# most.
_LEAST_LATE_TOUCHING = 0.5
# Ratios of rates to velocities that are noticed, and by so many standard errors.
_LEAST_RATIO, _LEAST_LONG_RATIO, _RATIO_SDS = 1.1, 1.5, 5.0
# Fewer rows tell nothing; so many have to bear the weight of a slope.
_FEWEST, _LEAST_WEIGHED = 6, 4.0
# Velocities that turn by more than so much in a row [rad] are longer than the way that
# is gone: no ratio is looked for.
_MOST_TURNED = 0.5
# Ranges of poses, in root mean squares of their steps, that are motion.
_FAR = 6.0
# Rows over which ratios are looked at besides single ones.
_LONG_SPAN = 5
_TWIST = {"positions": "velocities", "angles": "angular velocities"}
_UNIT = {"positions": "metres", "angles": "radians"}


def pose_velocity_reasons(spec: SceneSpec, history: History) -> list[str]:
    """Reasons for doubt about velocities, or lengths of steps, that poses contradict.

    A recording of poses alone is as good as its poses: ten pins that a simulator moved
    by one step a row had masses within 5 % without velocities, 1.7 to 2.1 times as
    large with them.

    Right recordings (pushed free, pinned and dry boxes, pendulums, drag, discs and a
    box that collide, bodies at rest; 8 to 200 rows of 5 to 50 ms; read exactly, or with
    noise in which that of poses or of velocities is far larger): of 1,080 motions read
    15 times each, 18,000 bodies in all, 2 were named, both of one motion on a dry
    floor; of this engine's random worlds and of boxes on MuJoCo's floor 2 of 2,720.
    Boxes that stick and slip there, pushed with pauses: 1 of 720, and 30 of 360 that
    were read exactly. Damping that stops a body within half a row looks late, too.

    With noise of 1 mm, 1 mrad, 4 mm/s and 4 mrad/s in 60 rows of 20 ms all 24 backward
    differences were named and all 120 smoothed ones; of 24 each 21 or more with half or
    twice the time, degrees for radians or millimetres for metres, 16 with steps told a
    fifth or a quarter too short or long; single steps of a simulator in 8 of 8 for free
    and dry boxes, 5 of 8 for pinned ones (8 of 8 with a third of the noise). What noise
    hides is not seen.

    Args:
        spec: the scene, for names.
        history: its readings.

    Returns:
        One line for each body and finding. Nothing where velocities were not read.
    """
    least = _LEAST_LATE_TOUCHING if has_contact(spec.bodies) else _LEAST_LATE
    reasons = []
    for name, parts in _parts(spec, history):
        reasons += [f"{name}: {line}" for line in _lines(parts, least)]
    return reasons


def pose_velocity_notes(spec: SceneSpec, history: History) -> list[str]:
    """Notes on steps that seem to be of other lengths than told.

    Notes, since friction that stops a body and lets it go again within a row may look
    the same. Of 24 recordings with such noise and jitter of a step's length of 8, 4 and
    2 ms (one sd) 15, 17 and 11 were noted with 60 rows, 22, 24 and 15 with 100.

    Args:
        spec: the scene, for names.
        history: its readings.

    Returns:
        One line for each body that has no reason for doubt of `pose_velocity_reasons`.
    """
    notes = []
    for name, parts in _parts(spec, history):
        jitter = None if _lines(parts, _LEAST_LATE) else step_jitter(parts)
        if jitter is not None:
            notes.append(
                f"{name}: {jitter.what} differ from what velocities say by more the "
                "faster it moves, as if lengths of steps varied by about "
                f"{1e3 * jitter.jitter:.2g} ms: expected measured times in 'dt'"
            )
    return notes


def _parts(spec: SceneSpec, history: History) -> list[tuple[str, list[Steps]]]:
    """Of each body that can move, its name and what is compared."""
    return [
        (
            spec.names[body],
            [steps_of(history, int(body), *part) for part in (POSITIONS, ANGLES)],
        )
        for body in np.flatnonzero(~np.asarray(spec.is_static))
    ]


def _lines(parts: list[Steps], least_late: float) -> list[str]:
    """What is said of one body."""
    lines, late = [], []
    for part in parts:
        if _is_zero(part):
            lines.append(
                f"{_TWIST[part.what]} are zero in all {len(part.dt)} rows in which "
                f"{part.what} change; expected NaN where they were not read"
            )
            continue
        lateness, ratio = _lateness(part), _ratio(part)
        # Between the two is decided by which leaves less unexplained.
        if ratio is not None and not (
            lateness.share > least_late and lateness.left <= ratio.left
        ):
            lines.append(
                f"{part.what} change {ratio.ratio:.3g} times as much in a step as "
                f"{_TWIST[part.what]} say; expected {_UNIT[part.what]}, seconds, and "
                "'dt' as long as the step"
            )
        elif lateness.share > least_late:
            late.append((part, lateness))
    if pooled_sds([lateness.sds for _, lateness in late]) > _LATE_SDS:
        lines.append(_late_line(late))
    return lines


def _is_zero(steps: Steps) -> bool:
    """Whether velocities are exactly zero while poses go somewhere.

    Poses that are noise about one place have a range of three or four of their steps.
    """
    if len(steps.dt) < _FEWEST or np.any(steps.first) or np.any(steps.last):
        return False
    moved = steps.rate * steps.dt[:, None]
    place = np.cumsum(moved, axis=0)
    reach = np.linalg.norm(place.max(axis=0) - place.min(axis=0))
    return bool(reach > _FAR * np.sqrt(np.mean(np.sum(moved**2, axis=1))))


def _late_line(late: list[tuple[Steps, "_Late"]]) -> str:
    """What is said of velocities that are late."""
    late = [each for each in late if each[1].sds > 0.5 * _LATE_SDS]
    part, most = max(late, key=lambda each: each[1].sds)
    before = 0.5e3 * most.share * float(np.median(part.dt))
    twists = " and ".join(_TWIST[part.what] for part, _ in late)
    poses = " and ".join(part.what for part, _ in late)
    return (
        f"{twists} look like differences of {poses} over the step that ends there, or "
        "delayed or filtered, or rows are few steps of a simulator (they fit about "
        f"{before:.2g} ms earlier); "
        "expected velocities measured at the reading's instant, and ten steps of a "
        "simulator or more a row: leave velocities out (NaN)"
    )


class _Late(NamedTuple):
    """Whether rates are nearer to the velocity at the end than the mean is."""

    sds: float
    """How many sds more rows say so than half of those with any change; 0: none."""
    share: float
    """Median c of what velocities are late by, in halves of a row."""
    left: float
    """Median of what it leaves of the rates."""


def _lateness(steps: Steps) -> _Late:
    """Of rates of velocities that are right either end is as near as the other.

    Noise of the two ends is independent of their mean's, so each row says late with
    probability one half or less.
    """
    change, rest = steps.half_change, steps.rate - steps.mean
    size = np.sum(change**2, axis=1)
    use = size > 0.0
    num = int(np.sum(use))
    if num < _FEWEST or _is_of_few_rows(size):
        return _Late(0.0, 0.0, np.inf)
    along = np.sum(rest * change, axis=1)
    votes = int(np.sum(along[use] > _LEAST_LATE * size[use]))
    share = weighted_median(along[use] / size[use], size[use])
    left = float(np.median(norm_of(rest - share * change)))
    counted = (2.0 * votes - num) / np.sqrt(num)
    # How large pushes were counts as well, where noise hides all but large ones.
    beyond = (rest - _LEAST_LATE * change)[use].ravel()
    correlation = float(np.mean(ranks_of(beyond) * ranks_of(change[use].ravel())))
    ranked = sds_of_correlation(correlation, len(beyond) / SHARED)
    return _Late(max(counted, ranked), share, left)


class _Ratio(NamedTuple):
    """Rates that are not what velocities say, and by how many times."""

    ratio: float
    left: float


def _ratio(steps: Steps) -> _Ratio | None:
    """How many times as large as velocities rates are, if that is not one.

    Noise of what a regression is on makes its slope smaller and never larger. So rates
    have to be too large in a regression on velocities, or velocities in one on rates.
    Velocities that are themselves smoothed poses share their noise. Over several rows
    at once that matters little, so the ratio has to be as much off there.
    """
    if _turns_much(steps):
        return None
    spans = [_spans(steps, length) for length in (1, _LONG_SPAN)]
    spans = [span for span in spans if len(span[0]) >= _FEWEST]
    for flips in (False, True):
        found = [
            _slope(*(span if flips else span[::-1]), overlap)
            for span, overlap in zip(spans, (2, 1 + _LONG_SPAN), strict=False)
        ]
        # An impact may be a few percent of several rows, and they have little noise.
        least = (_LEAST_RATIO, _LEAST_LONG_RATIO)
        is_sure = any(
            one.sds > _RATIO_SDS and one.slope > ratio
            for one, ratio in zip(found, least, strict=False)
        )
        if is_sure and all(one.slope > _LEAST_RATIO for one in found):
            ratio = found[-1].slope ** (-1 if flips else 1)
            left = float(np.median(norm_of(steps.rate - ratio * steps.mean)))
            return _Ratio(ratio, left)
    return None


def _turns_much(steps: Steps) -> bool:
    """Whether velocities are of a body that goes round fast."""
    if len(steps.dt) == 0 or steps.first.shape[1] < 2:
        return False
    one, two = steps.first, steps.last
    cross = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    turned = np.abs(np.arctan2(cross, np.sum(one * two, axis=1)))
    weight = np.sum(one**2, axis=1) + np.sum(two**2, axis=1)
    return weighted_median(turned, np.maximum(weight, 1e-300)) > _MOST_TURNED


def _spans(
    steps: Steps, length: int
) -> tuple[Float[np.ndarray, "span part"], Float[np.ndarray, "span part"]]:
    """How far poses go in so many rows on end, and how far mean velocities say."""
    moved = []
    for rate in (steps.rate, steps.mean):
        total = np.cumsum(rate * steps.dt[:, None], axis=0)
        total = np.concatenate([np.zeros_like(total[:1]), total])
        moved.append(total[length:] - total[:-length])
    num = max(len(steps.dt) - length + 1, 0)
    is_whole = steps.run[length - 1 :] == steps.run[:num]
    return moved[0][:num][is_whole], moved[1][:num][is_whole]


class _Slope(NamedTuple):
    """Of a line through the origin: the less of least squares' and the median's."""

    slope: float
    sds: float
    """How many standard errors it is above one."""


def _is_of_few_rows(weights: Float[np.ndarray, " row"]) -> bool:
    """Whether some rows outweigh all others, as one of an impact or of a start may."""
    total = float(np.sum(weights))
    return total**2 <= _LEAST_WEIGHED * float(np.sum(weights**2))


def _slope(x: np.ndarray, y: np.ndarray, overlap: int) -> _Slope:
    size, along = np.sum(x**2, axis=1), np.sum(x * y, axis=1)
    use = size > 0.0
    if _is_of_few_rows(size):
        return _Slope(0.0, 0.0)
    slope = float(np.sum(along) / np.sum(size))
    rest = y - slope * x
    spread = overlap * np.sum(rest**2) / max(rest.size - 1, 1) / np.sum(size)
    middle = weighted_median(along[use] / size[use], size[use])
    num = max(rest.size - 1, 1)
    squared = max(slope - 1.0, 0.0) ** 2 / max(float(spread), 1e-18)
    # Of few rows the residuals' own spread is uncertain: Student's t as a normal.
    return _Slope(min(slope, middle), float(np.sqrt(num * np.log1p(squared / num))))
