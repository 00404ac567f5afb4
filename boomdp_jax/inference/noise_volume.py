r"""What each of many noises leaves open: one linearised track for all of them.

How noise weighs readings decides how wide a posterior is. To fit anew for every noise
would take a filter and a Jacobian each. But where the track of one of them is known,
others are near it, and the step along it, $x' = f + A (x - r) + G (z - \hat z)$, is the
same for all: a filter then needs no physics. What it carries is the mean's derivative
by coordinates beside the mean itself, and out come the sums over readings of which
gradient and Gauss-Newton matrix are made.

Readings are taken channel by channel, which makes innovations independent of each other
as whitening by a Cholesky factor does.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.inference.evaluate import single_steps
from boomdp_jax.inference.filtered_likelihood import CHANNEL_GROUPS
from boomdp_jax.inference.fit import Host, with_prior
from boomdp_jax.inference.kalman import Filtered, channel_scale, kick_scale, start_scale
from boomdp_jax.inference.noise_level import NoiseFit
from boomdp_jax.inference.one_step import NOISE_SHAPE
from boomdp_jax.inference.target import StructureTarget
from boomdp_jax.inference.track_data import TrackData, TrackRow
from boomdp_jax.inference.tracking import channel_difference
from boomdp_jax.inference.used_rows import scan_used

_NUM_CHANNELS = 6
# Steps of the differences by coordinates, in posterior standard deviations, and their
# limits in prior ones: one step shows far less of a coordinate than all rows do.
_DIFFERENCE, _LEAST, _MOST = 0.2, 1e-2, 3e-2


class OpenVolumes(NamedTuple):
    """Of each of a list of noises, on the host."""

    log_volume: np.ndarray
    """By how much a structure's evidence exceeds its density at a hypothesis near its
    best fit, but for a constant, `[noise]`; -1e30 for noises so far off that nothing
    finite comes out."""
    variance: np.ndarray
    """Of each coordinate, one where it is not in use, `[noise, dim]`."""


class _Row(NamedTuple):
    """One step of the track, linearised; or all of them with a leading time axis."""

    state: Float[Array, "*time channel"]
    """Before the step."""
    change: Float[Array, "*time channel"]
    slope: Float[Array, "*time channel channel"]
    rise: Float[Array, "*time channel dim"]
    read: TrackRow


def open_volumes(
    targets: StructureTarget,
    structure: int,
    champion: np.ndarray,
    precision: np.ndarray,
    track: tuple[NoiseFit, Filtered],
    noise: NoiseFit,
) -> OpenVolumes:
    """Work out what noises leave open.

    Args:
        targets: with a `FilteredLikelihood`, of one object of one body.
        structure: which.
        champion: hypothesis near the best fit of all noises, `[dim]`.
        precision: about it, of some noise, `[dim, dim]`.
        track: a noise and the filter of the champion with it, leading axis of one.
        noise: those of which it is asked.
    """
    likelihood: Any = targets.log_likelihood
    data = jax.tree.map(lambda leaf: leaf[0], likelihood.data)
    rows = _linearised(targets, data, structure, champion, precision, track)
    level = jax.tree.map(
        lambda leaf: jnp.asarray(leaf, targets.log_prior.dtype),
        (noise.reading, noise.impulse),
    )
    sums, num = (np.asarray(x, float) for x in _sums(rows, data, *level))
    square = sums[:, :, -1, -1]
    host = Host.of(targets)
    # Of the prior of the factor by which this noise may be off.
    scale = np.asarray(likelihood.coordinates.scales.noise, float)[0]
    rate = (scale / noise.reading[:, 0]) ** 2
    weight = (NOISE_SHAPE + 0.5 * num) / (rate + 0.5 * square)
    total = np.einsum("mg,mgij->mij", weight, sums)
    is_finite = np.isfinite(total).all(axis=(1, 2))
    total = np.where(is_finite[:, None, None], total, 0.0)
    each = np.full(len(total), structure)
    z = np.tile(champion, (len(total), 1))
    gradient, matrix = with_prior(host, each, z, total[:, :-1, -1], total[:, :-1, :-1])
    return OpenVolumes(
        np.where(is_finite, log_volume(gradient, matrix), -1e30),
        np.diagonal(np.linalg.inv(matrix), axis1=1, axis2=2),
    )


def log_volume(gradient: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """By how much Laplace evidence exceeds the density where it was expanded.

    But for a constant.

    Args:
        gradient: of minus the log-density there, `[point, dim]`.
        matrix: its second derivatives, `[point, dim, dim]`.
    """
    step = np.linalg.solve(matrix, gradient[..., None])[..., 0]
    gain = 0.5 * np.sum(step * gradient, axis=1)
    return gain - 0.5 * np.linalg.slogdet(matrix)[1]


def _linearised(
    targets: StructureTarget,
    data: TrackData,
    structure: int,
    champion: np.ndarray,
    precision: np.ndarray,
    track: tuple[NoiseFit, Filtered],
) -> _Row:
    """The steps along a track, and their derivatives by differences."""
    noise, filtered = track
    state = _before_steps(data, filtered)
    scale = np.asarray(channel_scale(noise.reading[0]), float).reshape(-1)
    dim = len(champion)
    length = np.sqrt(np.maximum(np.diagonal(precision), 1.0))
    delta = np.clip(_DIFFERENCE / length, _LEAST, _MOST)
    # As about the readings' noise as the filter's differences are (`kalman`).
    starts = np.concatenate([state[None], state[None] + np.diag(scale)[:, None]])
    points = np.tile(champion, (len(starts), 1 + dim, 1))
    points[:, 1:] += np.diag(delta)
    none = np.zeros(len(starts), int)
    change = single_steps(
        targets, none, none + structure, starts[:, :, None], points
    ).squeeze(axis=3)
    here = change[0, 0]
    by_state = (change[1:, 0] - here[None]) / scale[:, None, None]
    by_coordinate = (change[0, 1:] - here[None]) / delta[:, None, None]
    dtype = targets.log_prior.dtype

    def put(array: np.ndarray) -> Array:
        return jnp.asarray(np.nan_to_num(array), dtype)

    return _Row(
        state=put(state),
        change=put(here),
        slope=put(np.moveaxis(by_state, 0, -1) + np.eye(_NUM_CHANNELS)),
        rise=put(np.moveaxis(by_coordinate, 0, -1)),
        read=data.rows,
    )


def _before_steps(data: TrackData, filtered: Filtered) -> np.ndarray:
    """Means after the first reading of each row, `[time, 6]`."""
    start = jnp.asarray(filtered.starts[0, :, 0])
    miss = np.asarray(channel_difference(data.steps.state[:, 0], start))
    seen = np.where(np.asarray(data.first_mask)[:, 0] > 0, miss, 0.0)
    gain = np.asarray(filtered.gains.first[0], float)
    return np.asarray(start) + np.einsum("tij,tj->ti", gain, seen)


@QuickCompile
@full_precision
def _sums(rows: _Row, data: TrackData, reading, impulse):
    """Products of innovations and their derivatives, summed by channel group.

    Noises are the last axis of all that is carried.

    Returns:
        Sums `[noise, group, dim + 1, dim + 1]`, the innovation itself last, and how
        many count, `[group]`.
    """
    variance = (channel_scale(reading[:, 0]) ** 2).T
    kick = (kick_scale(impulse[:, 0]) ** 2).T
    unknown = start_scale(1) ** 2
    num_noises, size = len(reading), rows.rise.shape[-1] + 1
    unit = jnp.eye(_NUM_CHANNELS, dtype=variance.dtype)[..., None]
    is_last = (jnp.arange(size) == size - 1).astype(variance.dtype)[:, None]

    def correct(mean, covariance, miss, mask):
        def one_channel(carry, inputs):
            mean, covariance = carry
            c, noise, miss, mask = inputs
            column = covariance[:, c]
            spread = column[c] + noise
            gain = column * (mask / spread)[None]
            error = miss * is_last - mean[c]
            mean = mean + gain[:, None] * error[None]
            covariance = covariance - gain[:, None] * column[None]
            return (mean, covariance), error * (mask * jax.lax.rsqrt(spread))[None]

        inputs = (np.arange(_NUM_CHANNELS), variance, miss, mask)
        return jax.lax.scan(one_channel, (mean, covariance), inputs)

    def advance(carry, row):
        mean, covariance, at, sums, num = carry
        read = row.read
        begins = read.is_start > 0
        first_mask, last_mask = read.first_mask[0], read.last_mask[0]
        moved = _difference(at, row.state)
        mean = mean + moved[:, None, None] * is_last[None]
        start = _difference(read.start[0], row.state)
        start = start[:, None, None] * is_last[None]
        mean = jnp.where(begins, start, mean)
        first = jnp.where(first_mask[:, None] > 0, variance, unknown[:, None])
        covariance = jnp.where(begins, unit * first[:, None], covariance)
        miss = _difference(read.first[0], row.state)
        (mean, covariance), one = correct(
            mean, covariance, miss, read.is_second * first_mask
        )
        mean = jnp.einsum("ij,jdm->idm", row.slope, mean)
        mean = mean + jnp.pad(row.rise, ((0, 0), (0, 1)))[..., None]
        covariance = covariance + unit * kick[:, None]
        half = jnp.einsum("ij,jkm->ikm", row.slope, covariance)
        half = jnp.swapaxes(half, 0, 1)
        covariance = jnp.einsum("jk,kim->jim", row.slope, half)
        after = row.state + row.change
        miss = _difference(read.last[0], after)
        (mean, covariance), two = correct(mean, covariance, miss, last_mask)
        weight = 1.0 if read.weight is None else read.weight
        counts = weight * (read.is_second * first_mask + last_mask)
        new = []
        for group in CHANNEL_GROUPS:
            parts = [u[c][:, None] * u[c][None] for u in (one, two) for c in group]
            new.append(weight * sum(parts[1:], parts[0]))
        here = jnp.stack([sum(counts[c] for c in group) for group in CHANNEL_GROUPS])
        return (mean, covariance, after, sums + jnp.stack(new), num + here), None

    carry = (
        jnp.zeros((_NUM_CHANNELS, size, num_noises), variance.dtype),
        unit * jnp.ones_like(variance)[:, None],
        jnp.zeros_like(rows.state[0]),
        jnp.zeros((len(CHANNEL_GROUPS), size, size, num_noises), variance.dtype),
        jnp.zeros(len(CHANNEL_GROUPS), variance.dtype),
    )
    carry, _ = scan_used(advance, carry, rows, data.is_used)
    return jnp.moveaxis(carry[3], -1, 0), carry[4]


def _difference(reading, state):
    """Between two states of one body, angles the shorter way round."""
    return channel_difference(reading[None], state[None])[0]
