"""Whether a body rests, as far as noise, rounding and gross errors let one tell."""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from boomdp_jax.core.history import History
from boomdp_jax.inference.hypotheses.prior import read_prior
from boomdp_jax.inference.readings.outliers import SD_OF_MEDIAN
from boomdp_jax.inference.readings.tie_misfit import running_median
from boomdp_jax.physics.scene_spec import SceneSpec

# Readings from which their noise is told, and sds of it that one at rest may be off by.
_FEWEST, _NUM_SDS = 6, 5.0
# Readings of which the noise is taken for twice as large as it seems.
_FEW = 10.0
# Of a median over a mean, standard errors of normal noise.
_ERROR_OF_MEDIAN = 1.2533
# Noise [m] above which what shakes cannot be told from what rests.
_COARSEST = 0.03
# What rounding leaves of a difference of readings of one pose [m, rad, m/s, rad/s].
_ROUNDING = 1e-5


def is_at_rest(spec: SceneSpec, history: History, body: int, fewest: int = 2) -> bool:
    """Whether all readings of a body are of one place, and of no velocity.

    Args:
        spec: the scene.
        history: its readings.
        body: which body.
        fewest: readings of its place that it takes to say so.

    Returns:
        False as well where too little was read to say so.
    """
    rows = np.asarray(history.mask)
    episode = np.asarray(history.episode)[rows]
    parts = []
    for values, is_read in (
        # The end of a row is the start of the next one: one reading, not two.
        (history.state, history.is_start_new([body])[:, 0]),
        (history.next_state, np.asarray(history.next_state_mask)[:, body]),
    ):
        array = np.asarray(values, float)[rows, body]
        parts.append(np.where(is_read[rows], array, np.nan))
    reading = np.stack(parts, axis=1).reshape(-1, 6)
    run = np.repeat(episode, 2)
    if not np.any(np.all(np.isfinite(reading[:, :2]), axis=-1)):
        return False
    scale = read_prior(spec.prior, spec.source).noise
    groups = ("position", "position", "angle", "velocity", "velocity", "spin")
    unit = (1.0, 1.0, spec.bodies[body].reach)
    for channel, group in enumerate(groups):
        use = np.isfinite(reading[:, channel])
        value, of = reading[use, channel], run[use]
        if len(value) == 0:
            continue
        if group == "angle":
            value = np.angle(np.exp(1j * (value - value[0])))
        middle = np.median(value) if channel < 3 else 0.0
        sd, digit = _noise(value, of, float(scale[group]))
        if channel < 3 and sd * unit[channel] > _COARSEST:
            return False
        if not _stays(value - middle, of, sd, digit):
            return False
    return int(np.sum(np.isfinite(reading[:, 0]))) >= fewest


def _noise(value: np.ndarray, run: np.ndarray, prior: float) -> tuple[float, float]:
    """Of single readings, by how much one differs from the next of its run.

    And their last digit: the least by which two differ.
    """
    change = np.diff(value)[run[1:] == run[:-1]]
    if len(change) < _FEWEST - 1:
        return prior, 0.0
    size = np.abs(change)
    off = np.abs(change - np.median(change))
    sd = SD_OF_MEDIAN * float(np.median(off)) / np.sqrt(2.0)
    digit = float(np.min(size, where=size > 0.0, initial=np.max(size)))
    # Few readings say little of noise.
    return sd * (1.0 + _FEW / len(value)), digit


def _stays(off: np.ndarray, run: np.ndarray, sd: float, digit: float) -> bool:
    """Whether what was read, off what is expected at rest, is noise in each run.

    Medians of a few readings in a row, from which gross errors have gone, find what
    came back; halves of runs find what is slow. One reading alone may be wrong, but not
    the last one of a run: what it is off by may be where the body went.
    """
    least = digit + _ROUNDING
    smooth = running_median(off[:, None], run)[0]
    if np.max(np.abs(smooth)) > _NUM_SDS * sd + least:
        return False
    for mine in np.split(off, np.flatnonzero(np.diff(run) != 0) + 1):
        if len(mine) < _FEWEST:
            continue
        three = np.median(sliding_window_view(mine, 3), axis=-1)
        if max(np.max(np.abs(three)), abs(mine[-1])) > _NUM_SDS * sd + least:
            return False
        half = len(mine) // 2
        error = _NUM_SDS * _ERROR_OF_MEDIAN * sd
        moved = abs(np.median(mine[-half:]) - np.median(mine[:half]))
        if moved > error * np.sqrt(2.0 / half) + least:
            return False
        # Of all runs together the median is zero, of each one it is close to that.
        if abs(np.median(mine)) > error * np.sqrt(2.0 / len(mine)) + least:
            return False
    return True
