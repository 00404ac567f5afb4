"""Velocities as poses tell them, for first fits to recordings that lack them.

Fits begin with single steps from what was read (`find_modes`), and guesses of where a
pin or an axle would have to be with the velocities there. Where a start's velocities
were not read there is no such step. Slopes of the poses round it stand in for them: far
noisier, and errors of neighbours are alike, but good enough to tell in which basin
a fit is. Where readings are rarer than steps, or channels are read in turn, no step may
lead from one instant that was read in full to another: what was between the readings is
then taken from those round it. (Climbs that began with nothing took twelve of sixteen
pinned boxes for free or on wheels, without a doubt.)

Filters, which come after that, are given what was read and nothing else.
"""

from typing import Any

import equinox as eqx
import jax
import numpy as np

from boomdp_jax.core.arrays import on_device
from boomdp_jax.inference.likelihoods.kalman import channel_scale
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.likelihoods.tracking import one_step_gains
from boomdp_jax.inference.readings.between_readings import between_readings
from boomdp_jax.inference.readings.track_data import TrackData

# How long before and after an instant poses tell of its velocity [s]: what a camera
# resolves is then a centimetre a second, and pushes change little. As many steps, at
# least one and no more than some.
_REACH, _MOST_STEPS = 0.06, 12
# Share of the steps between the first reading and the last that has to be known.
_ENOUGH = 0.5


def with_read_velocities(targets: StructureTarget) -> StructureTarget:
    """Targets whose single steps start from velocities of poses where none were read.

    Args:
        targets: with one-step gains, stacked along a leading object axis.

    Returns:
        The same, with other readings and gains to match; the very targets where nothing
        is missing.
    """
    likelihood: Any = targets.log_likelihood
    data = jax.tree.map(np.asarray, likelihood.data)
    is_read = np.any((data.first_mask > 0) | (data.last_mask > 0), axis=(-2, -1))
    lacks = (data.first_mask[..., :3] > 0) & (data.first_mask[..., 3:] == 0)
    if not lacks.any() and not np.any(_are_rare(data.steps.mask, is_read)):
        return targets
    objects = range(len(data.is_start))
    filled = [_filled(jax.tree.map(lambda x, i=i: x[i], data)) for i in objects]
    # The noise, like the gains, is alike for all structures.
    noise = np.asarray(likelihood.reference)[:, 0]
    gains = [
        one_step_gains(one, channel_scale(scale))
        for one, scale in zip(filled, noise, strict=True)
    ]

    def stacked(new, old):
        whole = np.stack([np.asarray(leaf) for leaf in new])
        spread = whole if whole.ndim == old.ndim else whole[:, None]
        return on_device(np.broadcast_to(spread, old.shape), np.dtype(old.dtype))

    return eqx.tree_at(
        lambda t: (t.log_likelihood.data, t.log_likelihood.gains),
        targets,
        (
            jax.tree.map(lambda old, *new: stacked(new, old), likelihood.data, *filled),
            jax.tree.map(lambda old, *new: stacked(new, old), likelihood.gains, *gains),
        ),
    )


def _filled(data: TrackData) -> TrackData:
    """Readings of one object, on the host, with velocities where poses tell them."""
    num_rows = len(data.is_start)
    dt = np.broadcast_to(np.asarray(data.steps.dt, float), (num_rows,))
    longest = float(np.max(dt))
    reach = 1 if longest <= 0 else int(np.clip(_REACH / longest, 1, _MOST_STEPS))
    first, last = (
        np.array(x, float) for x in (data.steps.state, data.steps.next_state)
    )
    first_mask, last_mask = (np.array(x) > 0 for x in (data.first_mask, data.last_mask))
    begins = np.flatnonzero(np.asarray(data.is_start) > 0)
    tracks = [
        slice(*ends) for ends in zip(begins, [*begins[1:], num_rows], strict=True)
    ]
    read_mask = first_mask.copy(), last_mask.copy()
    for rows in tracks:
        # Instants of a track: where it starts, and where each of its rows ends.
        begin = rows.start
        time = np.concatenate([[0.0], np.cumsum(dt[rows])])
        pose = np.concatenate([first[begin : begin + 1], last[rows]])[..., :3]
        read = np.concatenate([first_mask[begin : begin + 1], last_mask[rows]])[..., :3]
        velocity, is_known = _slopes(time, pose, read, reach)
        for values, mask, some in (
            (first, first_mask, slice(None, -1)),
            (last, last_mask, slice(1, None)),
        ):
            # Only where the pose was read as well, which rows that are not in use lack.
            is_new = is_known[some] & mask[rows, :, :3] & ~mask[rows, :, 3:]
            part = values[rows, :, 3:]
            values[rows, :, 3:] = np.where(is_new, velocity[some], part)
            mask[rows, :, 3:] |= is_new
    steps = np.all(first_mask, axis=(-2, -1), keepdims=True) & last_mask
    if _are_rare(steps, np.any(read_mask[0] | read_mask[1], axis=(-2, -1))):
        first_mask, last_mask = read_mask
        for rows in tracks:
            parts = [part[rows] for part in (dt, first, last, first_mask, last_mask)]
            _fill_between(*parts, reach)
    is_whole = np.all(first_mask, axis=(-2, -1), keepdims=True)
    start = np.where(first_mask, first, data.start)
    arrays = (first, last, is_whole & last_mask, first_mask, last_mask, start)
    dtype = np.asarray(data.start).dtype
    return eqx.tree_at(
        lambda d: (
            d.steps.state,
            d.steps.next_state,
            d.steps.mask,
            d.first_mask,
            d.last_mask,
            d.start,
        ),
        data,
        tuple(np.asarray(array, dtype) for array in arrays),
    )


def _are_rare(steps: np.ndarray, is_read: np.ndarray) -> np.ndarray:
    """Whether few steps lead from one instant that is known to another.

    Args:
        steps: which channels they lead to, `[*any, time, body, 6]`.
        is_read: rows of which anything was read, `[*any, time]`.
    """
    after = np.cumsum(is_read, axis=-1) > 0
    before = np.flip(np.cumsum(np.flip(is_read, -1), axis=-1), -1) > 0
    num = np.any(np.asarray(steps) > 0, axis=(-2, -1)).sum(axis=-1)
    return np.asarray(num < _ENOUGH * (after & before).sum(axis=-1))


def _fill_between(
    dt: np.ndarray,
    first: np.ndarray,
    last: np.ndarray,
    first_mask: np.ndarray,
    last_mask: np.ndarray,
    reach: int,
) -> None:
    """Put what the readings of a run tell of the instants between them in its rows.

    Args:
        dt: of each row [s].
        first: readings that rows start from, `[time, body, 6]`; changed.
        last: readings that they end at; changed.
        first_mask: which of them were read; changed.
        last_mask: see there.
        reach: as `between_readings` has it.
    """
    values = np.concatenate([first[:1], last])
    read = np.concatenate([first_mask[:1], last_mask])
    # Of an instant of which one row's end was not read, the start of the next may be.
    is_other = first_mask[1:] & ~read[1:-1]
    values[1:-1] = np.where(is_other, first[1:], values[1:-1])
    read[1:-1] |= is_other
    time = np.concatenate([[0.0], np.cumsum(dt)])
    found, is_known = between_readings(time, values, read, reach)
    for rows, mask, some in (
        (first, first_mask, slice(None, -1)),
        (last, last_mask, slice(1, None)),
    ):
        is_new = is_known[some] & ~mask
        rows[:] = np.where(is_new, found[some], rows)
        mask |= is_new


def _slopes(
    time: np.ndarray, pose: np.ndarray, read: np.ndarray, reach: int
) -> tuple[np.ndarray, np.ndarray]:
    """Slope of the line through the poses round each instant, and where there is one.

    Args:
        time: of each instant [s].
        pose: `[instant, body, 3]`.
        read: which of them were.
        reach: instants before and after it that count.
    """
    sums = np.zeros((5, *pose.shape))
    for offset in range(-reach, reach + 1):
        here = np.arange(max(0, -offset), len(time) - max(0, offset))
        there = here + offset
        apart = (time[there] - time[here])[:, None, None]
        change = pose[there] - pose[here]
        change[..., 2] = np.arctan2(np.sin(change[..., 2]), np.cos(change[..., 2]))
        terms = np.broadcast_arrays(1.0, apart, apart**2, change, apart * change)
        counts = read[there] & read[here]
        sums[:, here] += np.where(counts, np.stack(terms), 0.0)
    num, once, twice, change, product = sums
    spread = num * twice - once**2
    is_known = spread > 0.0
    return (num * product - once * change) / np.where(is_known, spread, 1.0), is_known
