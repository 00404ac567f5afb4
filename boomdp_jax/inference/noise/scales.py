"""Noise of readings given draws, where a filter's gains are fixed."""

from typing import Any

import numpy as np

from boomdp_jax.core.arrays import Key
from boomdp_jax.core.random_numbers import host_generator
from boomdp_jax.inference.likelihoods.evaluate import evaluate_points
from boomdp_jax.inference.likelihoods.one_step import NOISE_SHAPE
from boomdp_jax.inference.likelihoods.target import StructureTarget


def draw_noise_scales(
    key: Key, targets: StructureTarget, structure, z, *, is_drawn: bool = True
) -> np.ndarray:
    """Noise scales given every draw, from their inverse-gamma distribution.

    Args:
        key: random key.
        targets: with a `FilteredLikelihood`, stacked along a leading object axis.
        structure: of each draw, `[object, draw]`.
        z: coordinates of each draw, `[object, draw, dim]`.
        is_drawn: whether noise is drawn, or the most probable one by its logarithm.

    Returns:
        Sd of position [m], angle [rad], velocity [m/s] and spin [rad/s], `[object,
        draw, body, 4]`.
    """
    num_objects, num_draws = structure.shape
    index = np.repeat(np.arange(num_objects), num_draws)
    structure = structure.reshape(-1)
    z = z.reshape(num_objects * num_draws, -1)
    found = evaluate_points(targets, index, structure, z)
    likelihood: Any = targets.log_likelihood
    reference = np.asarray(likelihood.reference, float)[index, structure]
    scale = np.asarray(likelihood.coordinates.scales.noise, float)[index, None]
    shape = NOISE_SHAPE + 0.5 * found.num
    rate = (scale / reference) ** 2 + 0.5 * found.square
    draws = host_generator(key).gamma(shape) if is_drawn else shape
    sd = reference * np.sqrt(rate / draws)
    return sd.astype(z.dtype).reshape(num_objects, num_draws, *sd.shape[1:])
