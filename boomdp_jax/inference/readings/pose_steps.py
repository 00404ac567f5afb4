"""Rows whose poses and velocities were both read at both ends, for comparing them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from boomdp_jax.core.history import History

# What rounding to single precision may leave of a change, as a share of values.
_ROUNDING = 1e-6
# Rows in which a body goes less far [m] or [rad] are at rest.
_STILL = 1e-8
SHARED = 1.5
"""How many times as much sums of products vary at most for readings that neighbours
share: noise of poses makes them correlated by a half, of either factor."""
POSITIONS, ANGLES = ("positions", (0, 1)), ("angles", (2,))
"""What is compared, and its channels."""


class Steps(NamedTuple):
    """Rows of one body of which a part of pose and twist was read at both ends."""

    what: str
    """Positions or angles."""
    rate: Float[np.ndarray, "row part"]
    """Mean rates [m/s] or [rad/s]."""
    first: Float[np.ndarray, "row part"]
    """Velocities at the starts."""
    last: Float[np.ndarray, "row part"]
    """Velocities at the ends."""
    beside: Float[np.ndarray, "row part"]
    """Mean of the velocities an instant before and after the row; NaN: not read."""
    dt: Float[np.ndarray, " row"]
    """[s]."""
    run: Int[np.ndarray, " row"]
    """Rows that follow each other have the same number."""
    index: Int[np.ndarray, " row"]
    """Which rows of the history they are."""

    @property
    def mean(self) -> Float[np.ndarray, "row part"]:
        """Mean of the velocities at both ends."""
        return 0.5 * (self.first + self.last)

    @property
    def half_change(self) -> Float[np.ndarray, "row part"]:
        """Half of what the velocity changes by, zero where that is rounding."""
        change = 0.5 * (self.last - self.first)
        size = np.abs(self.last) + np.abs(self.first)
        is_rounding = norm_of(change) <= _ROUNDING * norm_of(size)
        return np.where(is_rounding[:, None], 0.0, change)


def steps_of(
    history: History, body: int, what: str, channels: tuple[int, ...]
) -> Steps:
    """Rows of a body of which some channels and their rates were read.

    Args:
        history: readings of all bodies.
        body: which.
        what: `positions` or `angles`.
        channels: of a pose.
    """
    pose, twist = list(channels), [channel + 3 for channel in channels]
    first, last = (
        np.where(mask, np.asarray(values, float), np.nan)[:, body]
        for values, mask in (
            (history.state, np.asarray(history.state_mask)),
            (history.next_state, np.asarray(history.next_state_mask)),
        )
    )
    dt = np.asarray(history.dt, float)
    moved, is_wrapped = last[:, pose] - first[:, pose], False
    if what == "angles":
        is_wrapped = _is_wrapped(np.concatenate([first[:, 2], last[:, 2]]))
    if is_wrapped:
        moved = np.angle(np.exp(1j * moved))
    beside = np.full(moved.shape, np.nan)
    follows = np.asarray(history.is_chained)
    inner = np.flatnonzero(follows[1:-1] & follows[2:]) + 1
    beside[inner] = 0.5 * (first[inner - 1][:, twist] + last[inner + 1][:, twist])
    ends = first[:, twist], last[:, twist]
    is_read = np.asarray(history.mask) & (dt > 0.0)
    is_read &= np.all(np.isfinite(np.concatenate([moved, *ends], axis=1)), axis=1)
    # A simulator's bodies at rest creep, by laws that are no one's concern.
    goes = np.maximum(norm_of(moved), 0.5 * norm_of(ends[0] + ends[1]) * dt)
    with np.errstate(invalid="ignore"):
        is_read &= goes > _STILL
    if is_wrapped:
        # Of more than a quarter turn in a row nothing is certain.
        with np.errstate(invalid="ignore"):
            is_read &= np.abs(ends[0] + ends[1])[:, 0] * dt < np.pi
    run = np.cumsum(~(follows & is_read & np.append(False, is_read[:-1])))[is_read]
    dt = dt[is_read]
    return Steps(
        what,
        moved[is_read] / dt[:, None],
        ends[0][is_read],
        ends[1][is_read],
        beside[is_read],
        dt,
        run,
        np.flatnonzero(is_read),
    )


def _is_wrapped(angle: Float[np.ndarray, " reading"]) -> bool:
    """Whether angles may have been brought to within one turn."""
    read = angle[np.isfinite(angle)]
    span = float(np.ptp(read)) if len(read) else 0.0
    return np.pi < span <= 2.0 * np.pi * (1.0 + _ROUNDING)


def pooled_sds(sds: list[float]) -> float:
    """The largest of some statistics and of their sum, which is one as well.

    Args:
        sds: each in standard deviations of its own; none: zero.
    """
    return max(*sds, sum(sds) / np.sqrt(len(sds)), 0.0) if sds else 0.0


def norm_of(values: Float[np.ndarray, "row part"]) -> Float[np.ndarray, " row"]:
    """Length of each row's vector."""
    return np.sqrt(np.sum(values**2, axis=-1))


def weighted_median(
    values: Float[np.ndarray, " value"], weights: Float[np.ndarray, " value"]
) -> float:
    """The value with half of the weight on either side."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    place = int(np.searchsorted(total, 0.5 * total[-1]))
    return float(values[order][min(place, len(values) - 1)])


def ranks_of(values: Float[np.ndarray, " value"]) -> Float[np.ndarray, " value"]:
    """Ranks with mean zero and sd one."""
    ranks = np.argsort(np.argsort(values)) - 0.5 * (len(values) - 1)
    return ranks / np.sqrt(max(float(np.mean(ranks**2)), 0.25))


def sds_of_correlation(correlation: float, num: float) -> float:
    """Fisher's statistic of a correlation, normal with sd one where there is none.

    Args:
        correlation: found.
        num: of how many independent pairs.
    """
    bounded = np.clip(correlation, -0.999, 0.999)
    return float(np.arctanh(bounded) * np.sqrt(max(num - 3.0, 0.0)))
