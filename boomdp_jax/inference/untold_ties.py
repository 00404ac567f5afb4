"""Pairs of bodies of which no reading can say whether they are tied."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from boomdp_jax.core.history import History
from boomdp_jax.inference.outliers import SD_OF_MEDIAN
from boomdp_jax.inference.prior import read_prior
from boomdp_jax.inference.tie_misfit import running_median
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


class Untold(NamedTuple):
    """What keeps ties from being told."""

    is_at_rest: Bool[np.ndarray, " body"]
    """Bodies that were always read in one place, and that need nothing to hold them."""
    is_unread: Bool[np.ndarray, " body"]
    """Bodies of which nothing was read."""
    is_together: Bool[np.ndarray, "body body"]
    """Pairs of which something was read in one run."""

    def has(self, a: int, b: int) -> bool:
        """Whether nothing tells of a tie of two bodies."""
        return bool(
            (self.is_at_rest[a] and self.is_at_rest[b]) or not self.is_together[a, b]
        )


def find_untold(spec: SceneSpec, history: History) -> Untold:
    """Find the pairs of which nothing tells whether they are tied.

    Two bodies at rest that nobody pushed stay where they are, tied or not, and so do
    two that were pushed too weakly where a floor may hold them. Where one of the two
    moves a tie shows, or where both were carried to another place between two runs. Of
    bodies that were not read in any run together there is nothing to compare.

    Args:
        spec: the scene.
        history: readings of all its bodies. Without rows, which ask for the prior,
            there are no such pairs.
    """
    num = spec.num_bodies
    rows = np.asarray(history.mask)
    none = np.zeros(num, bool)
    if not np.any(rows):
        return Untold(none, none, np.ones((num, num), bool))
    seen = np.asarray(history.state_mask) | np.asarray(history.next_state_mask)
    seen = np.any(seen[rows], axis=-1)
    episode = np.asarray(history.episode)[rows]
    runs = [np.any(seen[episode == run], axis=0) for run in np.unique(episode)]
    together = np.any([np.outer(run, run) for run in runs], axis=0)
    is_at_rest = none
    # On a slope rest tells that something holds a body.
    if not np.any(np.asarray(spec.scene.gravity) != 0.0):
        is_at_rest = np.array([_is_at_rest(spec, history, i) for i in range(num)])
        is_at_rest &= _may_rest(spec, np.asarray(history.action)[rows])
    return Untold(is_at_rest, ~np.any(runs, axis=0), together)


def untold_notes(
    spec: SceneSpec, untold: Untold, blocks: list[tuple[int, ...]]
) -> list[str]:
    """Say which ties are not asked for since nothing tells of them.

    Args:
        spec: the scene.
        untold: what keeps them from being told.
        blocks: bodies that are inferred together for other reasons, as those that may
            have touched: ties between them are asked for all the same.

    Returns:
        A line on all bodies at rest, one for each body that was not read, and one on
        what was not read together.
    """
    names, notes = spec.names, []
    resting = [[names[i] for i in block if untold.is_at_rest[i]] for block in blocks]
    groups = ["+".join(group) for group in resting if group]
    if len(groups) > 1:
        notes.append(
            f"{', '.join(groups)}: never moved, so that a tie between them cannot be "
            "told from two bodies that stay where they are; none is asked for"
        )
    parted = []
    for block in blocks:
        others = [i for other in blocks if other != block for i in other]
        for i in block:
            if untold.is_unread[i] and others:
                notes.append(
                    f"{names[i]}: nothing was read of it, so that a tie to "
                    f"{', '.join(names[j] for j in sorted(others))} cannot be told; "
                    "none is asked for"
                )
            parted += [
                f"{names[i]}-{names[j]}"
                for j in others
                if i < j
                and not untold.is_together[i, j]
                and not (untold.is_unread[i] or untold.is_unread[j])
            ]
    if parted:
        notes.append(
            f"{', '.join(parted)}: never read in one run, so that a tie between them "
            "cannot be told; none is asked for"
        )
    return notes


def _may_rest(spec: SceneSpec, action: np.ndarray) -> Bool[np.ndarray, " body"]:
    """Bodies that stay without a tie: nobody pushed them, or a floor may hold them.

    What is pushed on a floor that holds nothing is held by a joint.
    """
    has_floor = np.zeros(spec.num_bodies, bool)
    if float(spec.normal_gravity) > 0.0:
        has_floor[:] = spec.unknown.get("ground", 0) > 0
        for constraint in spec.constraints:
            has_floor[constraint.body_a] |= constraint.kind == "ground"
    return has_floor | ~np.any(action != 0.0, axis=(0, 2))


def _is_at_rest(spec: SceneSpec, history: History, body: int) -> bool:
    """Whether all readings of a body are of one place, and of no velocity."""
    rows = np.asarray(history.mask)
    episode = np.asarray(history.episode)[rows]
    parts = []
    for values, mask in (
        (history.state, history.state_mask),
        (history.next_state, history.next_state_mask),
    ):
        array = np.asarray(values, float)[rows, body]
        parts.append(np.where(np.asarray(mask)[rows, body], array, np.nan))
    # The end of a row is the start of the next one: one reading, not two.
    is_last = np.append(~np.asarray(history.is_chained)[rows][1:], True)
    parts[1][~is_last] = np.nan
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
    return int(np.sum(np.isfinite(reading[:, 0]))) > 1


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
    came back; halves of runs find what is slow.
    """
    least = digit + _ROUNDING
    smooth = running_median(off[:, None], run)[0]
    if np.max(np.abs(smooth)) > _NUM_SDS * sd + least:
        return False
    for mine in np.split(off, np.flatnonzero(np.diff(run) != 0) + 1):
        if len(mine) < _FEWEST:
            continue
        half = len(mine) // 2
        error = _NUM_SDS * _ERROR_OF_MEDIAN * sd
        moved = abs(np.median(mine[-half:]) - np.median(mine[:half]))
        if moved > error * np.sqrt(2.0 / half) + least:
            return False
        # Of all runs together the median is zero, of each one it is close to that.
        if abs(np.median(mine)) > error * np.sqrt(2.0 / len(mine)) + least:
            return False
    return True
