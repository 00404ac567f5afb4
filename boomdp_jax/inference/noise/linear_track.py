r"""Filters of many noises along linearised tracks, without physics.

A likelihood with other noises takes a filter, and how wide a posterior they leave a
Jacobian, for each of them. But where the track of one noise is known, others are near
it, and the step along it, $x' = f + A (x - r) + G (z - \hat z)$, is the same for all: a
filter then needs no physics. What it carries is the mean's derivative by coordinates
beside the mean itself, and out come the sums over readings of which likelihood,
gradient and Gauss-Newton matrix are made.

Readings are taken channel by channel, which makes innovations independent of each other
as whitening by a Cholesky factor does.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.core.spread import Program, run_each
from boomdp_jax.inference.fits.fit import Host
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit
from boomdp_jax.inference.hypotheses.periods import wrapped
from boomdp_jax.inference.likelihoods.chunking import CHUNK_SIZE
from boomdp_jax.inference.likelihoods.evaluate import single_steps
from boomdp_jax.inference.likelihoods.filter_points import filter_points
from boomdp_jax.inference.likelihoods.filtered_likelihood import CHANNEL_GROUPS
from boomdp_jax.inference.likelihoods.kalman import (
    Filtered,
    channel_scale,
    kick_scale,
    start_scale,
)
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.likelihoods.tracking import channel_difference
from boomdp_jax.inference.readings.track_data import TrackData, TrackRow
from boomdp_jax.inference.readings.used_rows import scan_used

# Steps of the differences by coordinates, in posterior standard deviations, and their
# limits in prior ones: one step shows far less of a coordinate than all rows do.
_DIFFERENCE, _LEAST, _MOST = 0.2, 1e-2, 3e-2
# Noises of one call, tracks that they may have, and numbers in use by which room for
# them grows: few programs.
_NUM_LANES, _MOST_TRACKS = 64, 8
_ROOM = 8
# Of the channels of a body.
_PERIOD = np.array([0.0, 0.0, 2.0 * np.pi, 0.0, 0.0, 0.0])


class NoiseSums(NamedTuple):
    """What is known of each of a list of noises, on the host."""

    log_scale: np.ndarray
    """Log-density of the readings but for their squared innovations, `[noise]`."""
    num: np.ndarray
    """How many readings of each channel group count, `[noise, body, 4]`."""
    products: np.ndarray
    """Products of innovations and their derivatives by the coordinates in use, the
    innovation itself last, summed over the readings of each channel group; `[noise,
    body, 4, number, number]`. Not finite for noises too far off."""
    number: np.ndarray
    """Which coordinates these are, `[noise, number - 1]`; `dim` where none is left."""
    dim: int

    @property
    def square(self) -> np.ndarray:
        """Sums of squared innovations, `[noise, body, 4]`."""
        return self.products[..., -1, -1]

    def weighed(self, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradient and Gauss-Newton matrix of half the squares, weighed.

        Args:
            weight: of each channel group, `[noise, body, 4]`.

        Returns:
            By all coordinates, `[noise, dim]` and `[noise, dim, dim]`, zero where one
            is not in use.
        """
        total = np.einsum("mbg,mbgij->mij", weight, self.products)
        gradient = np.zeros((len(total), self.dim + 1))
        matrix = np.zeros((len(total), self.dim + 1, self.dim + 1))
        row = np.arange(len(total))[:, None]
        gradient[row, self.number] = total[:, :-1, -1]
        place = self.number
        matrix[row[..., None], place[:, :, None], place[:, None]] = total[:, :-1, :-1]
        return gradient[:, :-1], matrix[:, :-1, :-1]


class _Row(NamedTuple):
    """Steps of tracks, linearised; leading axes `track` and `time` on the host."""

    state: np.ndarray
    """Before the step, `[*, body, 6]`."""
    change: np.ndarray
    slope: np.ndarray
    """Derivative by the state, `[*, channel, channel]`."""
    rise: np.ndarray
    """Derivative by the coordinates in use, `[*, channel, number]`."""


class LinearTracks(NamedTuple):
    """Tracks of a list of hypotheses, linearised; on the host."""

    champion: np.ndarray
    """The hypotheses, `[track, dim]`."""
    rows: _Row
    number: np.ndarray
    """Coordinates in use of each, `[track, number]`; `dim` where none is left."""
    read: TrackRow
    """Readings of each object."""
    is_used: np.ndarray
    """As `TrackData` has it, of each object."""
    index: np.ndarray
    """Object of each hypothesis."""

    @classmethod
    def along(
        cls,
        targets: StructureTarget,
        index: np.ndarray,
        structure: np.ndarray,
        champion: np.ndarray,
        precision: np.ndarray,
        noise: NoiseFit,
        filtered: Filtered | None = None,
    ) -> "LinearTracks":
        """Linearise the steps of hypotheses.

        Args:
            targets: with a `FilteredLikelihood`, stacked along a leading object axis.
            index: object of each hypothesis.
            structure: of each.
            champion: the hypotheses, each near the best fit of all its noises.
            precision: about each, with some noise, `[track, dim, dim]`.
            noise: of each, with which it is filtered.
            filtered: what comes of that, where it is known.
        """
        if filtered is None:
            filtered = filter_points(targets, index, structure, champion, noise)
        likelihood: Any = targets.log_likelihood
        data = jax.tree.map(np.asarray, likelihood.data)
        state = _before_steps(data, index, filtered)
        used, number = _numbers(Host.of(targets).in_use[structure])
        length = np.sqrt(np.maximum(np.diagonal(precision, axis1=1, axis2=2), 1.0))
        delta = used * np.clip(_DIFFERENCE / length, _LEAST, _MOST)[:, None]
        points = np.repeat(champion[:, None], 1 + used.shape[1], axis=1)
        points[:, 1:] += delta
        change = _changes(targets, index, structure, state, points)
        step = delta.sum(axis=-1)[..., None, None]
        rise = change[:, 1:] - change[:, :1]
        rise = np.where(step > 0, rise / np.where(step > 0, step, 1.0), 0.0)
        rows = _Row(
            state=state,
            change=change[:, 0].reshape(state.shape),
            slope=np.asarray(filtered.slopes),
            rise=np.moveaxis(rise, 1, -1),
        )
        dtype = targets.log_prior.dtype
        rows = jax.tree.map(lambda leaf: np.nan_to_num(leaf).astype(dtype), rows)
        is_used = np.asarray(likelihood.data.is_used)
        return cls(champion, rows, number, data.rows._replace(dt=None), is_used, index)

    def __call__(self, track: np.ndarray, noise: NoiseFit) -> NoiseSums:
        """Filter with each of a list of noises.

        Args:
            track: along which, `[noise]`.
            noise: of each.
        """
        num, order = len(track), np.argsort(track, kind="stable")
        dtype = self.rows.state.dtype
        is_used = self.is_used[self.index].any(axis=0)
        inputs, counts, begin = [], [], 0
        while begin < num:
            lanes = order[np.minimum(np.arange(begin, begin + _NUM_LANES), num - 1)]
            names, owner = np.unique(track[lanes], return_inverse=True)
            count = min(int(np.searchsorted(owner, _MOST_TRACKS)), num - begin)
            names = names[np.minimum(np.arange(_MOST_TRACKS), len(names) - 1)]
            rows = jax.tree.map(lambda leaf, own=names: leaf[own], self.rows)
            read = jax.tree.map(
                lambda leaf, own=names: leaf[self.index[own]], self.read
            )
            owner = np.minimum(owner, _MOST_TRACKS - 1).astype(np.int32)
            level = noise.reading[lanes], noise.impulse[lanes]
            level = [leaf.astype(dtype) for leaf in level]
            inputs.append((rows, read, owner, *level))
            counts.append(count)
            begin += count
        # With what shapes depend on: programs are made one after the other.
        shared = is_used, self.rows.rise[0, 0]
        found = [
            jax.tree.map(lambda leaf, n=count: leaf[:n], call)
            for call, count in zip(
                run_each(_LANES, shared, inputs), counts, strict=True
            )
        ]
        back = np.empty(num, int)
        back[order] = np.arange(num)
        log_scale, counts, products = jax.tree.map(
            lambda *parts: np.concatenate(parts)[back].astype(float), *found
        )
        number, dim = self.number[track], self.champion.shape[1]
        return NoiseSums(log_scale, counts, products, number, dim)


def _numbers(in_use: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates in use, as many places for each track.

    Args:
        in_use: `[track, dim]`.

    Returns:
        One where a place has a coordinate, `[track, place, dim]`, and which one it has,
        `[track, place]`; places left over have none, and `dim`.
    """
    dim = in_use.shape[1]
    most = int(in_use.sum(axis=1).max())
    room = min(-(-(most + 1) // _ROOM) * _ROOM - 1, dim)
    order = np.argsort(~in_use, axis=1, kind="stable")[:, :room]
    number = np.where(np.take_along_axis(in_use, order, axis=1), order, dim)
    return (number[..., None] == np.arange(dim)).astype(float), number


def _changes(
    targets: StructureTarget,
    index: np.ndarray,
    structure: np.ndarray,
    state: np.ndarray,
    points: np.ndarray,
) -> np.ndarray:
    """Changes of states by steps, `[track, point, time, channel]`."""
    num_tracks, num_points, dim = points.shape
    num_parts = -(-num_points // CHUNK_SIZE)
    end = num_parts * CHUNK_SIZE - num_points
    lists = np.pad(points, ((0, 0), (0, end if num_parts > 1 else 0), (0, 0)), "edge")
    each = np.repeat(np.arange(num_tracks), num_parts)
    change = single_steps(
        targets,
        index[each],
        structure[each],
        state[each],
        lists.reshape(len(each), -1, dim),
    )
    change = change.reshape(num_tracks, -1, *state.shape[1:])[:, :num_points]
    return change.reshape(*change.shape[:3], -1)


def _before_steps(data: TrackData, index: np.ndarray, filtered: Filtered) -> np.ndarray:
    """Means after the first reading of each row, `[track, time, body, 6]`."""
    start = np.asarray(filtered.starts, float)
    miss = wrapped(np.asarray(data.steps.state)[index] - start, _PERIOD)
    seen = np.where(data.first_mask[index] > 0, miss, 0.0).reshape(*start.shape[:2], -1)
    gain = np.asarray(filtered.gains.first, float)
    return start + np.einsum("ntij,ntj->nti", gain, seen).reshape(start.shape)


@full_precision
def _filter_lanes(shared, rows: _Row, read: TrackRow, owner, reading, impulse):
    """Filter along tracks, leading axis `track`, with noises, leading axis `lane`.

    Each lane has its owner's track. Lanes are the last axis of all that is carried.

    Returns:
        As `NoiseSums` has them.
    """
    is_used, _ = shared
    num_lanes, num_bodies = reading.shape[:2]
    num, size = 6 * num_bodies, rows.rise.shape[-1] + 1

    def in_lanes(array):
        return jnp.moveaxis(array.reshape(num_lanes, -1), 0, -1)

    variance = in_lanes(jax.vmap(channel_scale)(reading) ** 2)
    kick = in_lanes(jax.vmap(kick_scale)(impulse) ** 2)
    unknown = start_scale(num_bodies)[:, None] ** 2
    unit = jnp.eye(num, dtype=variance.dtype)[..., None]
    is_last = (jnp.arange(size) == size - 1).astype(variance.dtype)[:, None]
    difference = jax.vmap(channel_difference)

    def correct(mean, covariance, miss, mask):
        def one_channel(carry, inputs):
            mean, covariance = carry
            c, noise, miss, mask = inputs
            column = covariance[:, c]
            spread = column[c] + noise
            gain = column * (mask / spread)[None]
            error = miss[None] * is_last - mean[c]
            mean = mean + gain[:, None] * error[None]
            covariance = covariance - gain[:, None] * column[None]
            log_scale = -0.5 * mask * jnp.log(2.0 * jnp.pi * spread)
            return (mean, covariance), (
                error * (mask * jax.lax.rsqrt(spread))[None],
                log_scale,
            )

        inputs = (np.arange(num), variance, miss, mask)
        carry, found = jax.lax.scan(one_channel, (mean, covariance), inputs)
        return carry, found

    def advance(carry, inputs):
        mean, covariance, at, log_scale, counts = carry
        row, read = jax.tree.map(lambda leaf: leaf[owner], inputs)
        begins = read.is_start > 0
        first_mask, last_mask = in_lanes(read.first_mask), in_lanes(read.last_mask)
        first_used = in_lanes(read.is_second)
        moved = in_lanes(difference(at, row.state))
        start = in_lanes(difference(read.start, row.state))
        moved = jnp.where(begins[None], start, moved)
        mean = jnp.where(begins[None, None], 0.0, mean)
        mean = mean + moved[:, None] * is_last[None]
        known = jnp.where(first_mask > 0, variance, unknown)
        fresh = unit * known[:, None]
        covariance = jnp.where(begins[None, None], fresh, covariance)
        miss = in_lanes(difference(read.first, row.state))
        # Seldom is an instant read twice.
        (mean, covariance), one = jax.lax.cond(
            jnp.any(first_used > 0),
            lambda: correct(mean, covariance, miss, first_used),
            lambda: ((mean, covariance), (0.0 * mean, 0.0 * variance)),
        )
        slope, rise = jnp.moveaxis(row.slope, 0, -1), jnp.moveaxis(row.rise, 0, -1)
        mean = _product(slope, mean)
        mean = mean + jnp.pad(rise, ((0, 0), (0, 1), (0, 0)))
        covariance = covariance + unit * kick[:, None]
        half = jnp.swapaxes(_product(slope, covariance), 0, 1)
        covariance = _product(slope, half)
        after = row.state + row.change
        miss = in_lanes(difference(read.last, after))
        (mean, covariance), two = correct(mean, covariance, miss, last_mask)
        weight = jnp.ones_like(log_scale) if read.weight is None else read.weight
        log_scale = log_scale + weight * jnp.sum(one[1] + two[1], axis=0)
        counts = counts + weight[None] * (first_used + last_mask)
        share = jnp.sqrt(weight)[None, None]
        found = jnp.stack([share * one[0], share * two[0]])
        return (mean, covariance, after, log_scale, counts), found

    carry = (
        jnp.zeros((num, size, num_lanes), variance.dtype),
        jnp.broadcast_to(unit, (num, num, num_lanes)).astype(variance.dtype),
        jnp.zeros_like(rows.state[owner, 0]),
        jnp.zeros(num_lanes, variance.dtype),
        jnp.zeros((num, num_lanes), variance.dtype),
    )
    over_time = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 1, 0), (rows, read))
    carry, found = scan_used(advance, carry, over_time, is_used)
    # Time, which reading, body, channel, number, lane.
    found = found.reshape(*found.shape[:2], num_bodies, 6, size, num_lanes)
    products = []
    for group in CHANNEL_GROUPS:
        own = jnp.transpose(found[:, :, :, np.asarray(group)], (5, 2, 0, 1, 3, 4))
        own = own.reshape(num_lanes, num_bodies, -1, size)
        products.append(jnp.einsum("mbri,mbrj->mbij", own, own))
    counts = jnp.moveaxis(carry[4].reshape(num_bodies, 6, num_lanes), -1, 0)
    counts = [sum(counts[..., c] for c in group) for group in CHANNEL_GROUPS]
    return carry[3], jnp.stack(counts, axis=-1), jnp.stack(products, axis=2)


_LANES = Program(_filter_lanes)


def _product(one, two):
    """Of matrices `[*, *, lane]`, summed in one loop: dots would put lanes first."""
    return sum(one[:, j, None] * two[None, j] for j in range(one.shape[1]))
