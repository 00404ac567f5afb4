"""Noise of readings and motion at a hypothesis, and the gains that follow from it."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.spread import Program, run_each
from boomdp_jax.inference.fit import Fits
from boomdp_jax.inference.kalman import Filtered, NoiseLevel, extended_filter
from boomdp_jax.inference.target import StructureTarget

# Points filtered by one call of the compiled program.
_POINTS_PER_CALL = 8
# Prior of the impulses: log-normal about this share of the prior scale of velocity and
# spin readings. It has to keep an impulse that data do not show from wandering off.
_IMPULSE_SHARE, _IMPULSE_SPREAD = 0.1, 2.0
_NUM_ITERATIONS = 6
_DIFFERENCE = 0.2
_LONGEST_STEP = 1.5


class NoiseFit(NamedTuple):
    """Noise of each object, on the host."""

    reading: np.ndarray
    """`[object, body, 4]`."""
    impulse: np.ndarray
    """`[object, body, 2]`."""


def _gather(targets: StructureTarget, index, structure, z, noise) -> tuple:
    """What each point needs of the targets, so that their number is not compiled in."""
    likelihood: Any = targets.log_likelihood
    known = jax.tree.map(
        lambda leaf: leaf[index], (likelihood.coordinates, likelihood.data)
    )
    return known, targets.structures[index, structure], z, noise


def _filter_points(known, active, z, noise) -> Filtered:
    def one(known, active, z, noise):
        coordinates, data = known
        params = coordinates(z, active)
        return extended_filter(coordinates.scene, params, data, NoiseLevel(*noise))

    return jax.vmap(one)(known, active, z, noise)


_FILTERS = Program(_gather, _filter_points)


def filter_points(
    targets: StructureTarget,
    index: np.ndarray,
    structure: np.ndarray,
    z: np.ndarray,
    noise: NoiseFit,
) -> Filtered:
    """Run the extended filter at a list of points, each with its own noise.

    Args:
        targets: with a `FilteredLikelihood`, stacked along a leading object axis.
        index: object of each point.
        structure: of each point.
        z: coordinates of each point.
        noise: of each point.

    Returns:
        Gains and log-likelihoods, leading axis `point`, on the host.
    """
    num = len(index)
    dtype = targets.log_prior.dtype
    inputs = []
    for begin in range(0, num, _POINTS_PER_CALL):
        rows = np.minimum(np.arange(begin, begin + _POINTS_PER_CALL), num - 1)
        level = (noise.reading[rows].astype(dtype), noise.impulse[rows].astype(dtype))
        inputs.append(
            (
                index[rows].astype(np.int32),
                structure[rows].astype(np.int32),
                z[rows].astype(dtype),
                level,
            )
        )
    calls = run_each(_FILTERS, targets, inputs)
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:num], *calls)


def fit_noise(targets: StructureTarget, best: Fits, start: NoiseFit) -> NoiseFit:
    """Maximise the filter's marginal likelihood over the noise of each object.

    Newton's method on the logarithms with the diagonal of the Hessian, by differences;
    three lengths of every step are tried.

    Args:
        targets: with a `FilteredLikelihood`, stacked along a leading object axis.
        best: the one hypothesis of each object at which to do so, in order.
        start: where to start; better too high than too low.

    Returns:
        The noise.
    """
    num_objects, num_bodies = start.reading.shape[:2]
    likelihood: Any = targets.log_likelihood
    prior = np.asarray(likelihood.coordinates.scales.noise, float)

    def pack(noise: NoiseFit) -> np.ndarray:
        both = np.concatenate([noise.reading, noise.impulse], axis=-1)
        return np.log(both).reshape(num_objects, -1)

    def unpack(x: np.ndarray) -> NoiseFit:
        both = np.exp(x).reshape(-1, num_bodies, 6)
        return NoiseFit(both[..., :4], both[..., 4:])

    def objective(x: np.ndarray) -> np.ndarray:
        """Of `[object, try, number]`."""
        num_tries = x.shape[1]
        rows = np.repeat(np.arange(num_objects), num_tries)
        noise = unpack(x.reshape(-1, x.shape[-1]))
        found = filter_points(
            targets, best.index[rows], best.structure[rows], best.z[rows], noise
        )
        scale = prior[rows][:, None]
        ratio = (scale / noise.reading) ** 2
        log_prior = np.sum(np.log(ratio) - ratio, axis=(1, 2))
        middle = _IMPULSE_SHARE * scale[..., 2:]
        offset = np.log(noise.impulse / middle) / _IMPULSE_SPREAD
        log_prior -= 0.5 * np.sum(offset**2, axis=(1, 2))
        value = np.asarray(found.log_likelihood, float) + log_prior
        return np.where(np.isfinite(value), value, -np.inf).reshape(-1, num_tries)

    x = pack(start)
    size = x.shape[1]
    shifts = _DIFFERENCE * np.concatenate([np.zeros((1, size)), np.eye(size)])
    shifts = np.concatenate([shifts, -shifts[1:]])
    for _ in range(_NUM_ITERATIONS):
        values = objective(x[:, None] + shifts[None])
        here, up, down = values[:, :1], values[:, 1 : size + 1], values[:, size + 1 :]
        slope = (up - down) / (2.0 * _DIFFERENCE)
        bend = -(up - 2.0 * here + down) / _DIFFERENCE**2
        step = np.nan_to_num(slope / np.maximum(bend, 0.5))
        step = np.clip(step, -_LONGEST_STEP, _LONGEST_STEP)
        lengths = np.array([1.0, 0.5, 0.2])
        tries = x[:, None] + lengths[None, :, None] * step[:, None]
        found = objective(tries)
        choice = np.argmax(found, axis=1)
        each = np.arange(num_objects)
        is_better = found[each, choice] > here[:, 0]
        x = np.where(is_better[:, None], tries[each, choice], x)
        if np.all(np.abs(step).max(axis=1) < 0.05):
            break
    return unpack(x)


def with_gains(
    targets: StructureTarget, best: Fits, noise: NoiseFit
) -> StructureTarget:
    """Give every structure the gains of its own best fit.

    Args:
        targets: with a `FilteredLikelihood`, stacked along a leading object axis.
        best: one fit of every structure of every object, in order.
        noise: of each object.

    Returns:
        Targets whose likelihood tracks with the new gains.
    """
    num_objects, num_structures = targets.structures.shape[:2]
    rows = best.index
    found = filter_points(
        targets,
        rows,
        best.structure,
        best.z,
        NoiseFit(noise.reading[rows], noise.impulse[rows]),
    )
    dtype = targets.log_prior.dtype
    gains = jax.tree.map(
        lambda leaf: on_device(
            np.asarray(leaf).reshape(num_objects, num_structures, *leaf.shape[1:]),
            dtype,
        ),
        found.gains,
    )
    reference = on_device(noise.reading, dtype)
    return eqx.tree_at(
        lambda t: (t.log_likelihood.gains, t.log_likelihood.reference),
        targets,
        (gains, reference),
    )
