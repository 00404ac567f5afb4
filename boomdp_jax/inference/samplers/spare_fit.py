"""Components fitted to draws: what a bump on the mode leaves out, ridges and skew."""

import jax
import numpy as np

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.samplers.mixture_building import fit_spare_components

# A component is fitted to draws of a structure if this many per coordinate differ, and
# gets this share of the structure's weight.
_DRAWS_PER_DIM, _SHARE = 4, 0.6


@QuickCompile
def _fit_spare(targets, mixtures, mean, scale_tril, share):
    return jax.vmap(fit_spare_components)(targets, mixtures, mean, scale_tril, share)


def fit_spare(
    targets: StructureTarget,
    mixtures: LaplaceMixture,
    structure: np.ndarray,
    z: np.ndarray,
    weight: np.ndarray | None = None,
) -> LaplaceMixture:
    """Fit a component to the draws in each structure where there are enough.

    Args:
        targets: stacked along a leading object axis.
        mixtures: of `add_spare_components`, one of each object.
        structure: of each draw, `[object, draw]`.
        z: coordinates of each draw, `[object, draw, dim]`.
        weight: of each draw `[object, draw]`, need not be normalised; default: equal.

    Returns:
        Mixtures whose spare components are filled where the draws allow it: where so
        many differ, and count for as many by Kish's effective sample size.
    """
    weight = np.ones(structure.shape) if weight is None else weight
    num_objects, num_structures = targets.structures.shape[:2]
    dim = z.shape[-1]
    period = np.asarray(targets.period, float)
    mean = np.zeros((num_objects, num_structures, dim))
    tril = np.tile(np.eye(dim), (num_objects, num_structures, 1, 1))
    share = np.zeros((num_objects, num_structures))
    for i, k in np.ndindex(num_objects, num_structures):
        is_mine = (structure[i] == k) & (weight[i] > 0)
        mine, own = z[i, is_mine].astype(float), weight[i, is_mine]
        if _num_effective(mine, own) < _DRAWS_PER_DIM * dim:
            continue
        own = own / own.sum()
        is_angle = period[i] > 0
        turn = np.where(is_angle, period[i], 1.0)
        offset = mine - mine[np.argmax(own)]
        offset -= np.where(is_angle, turn * np.round(offset / turn), 0.0)
        middle = own @ offset
        # Coordinates not in use are all zero and get a scale of one.
        in_use = np.ptp(mine, axis=0) > 0
        centred = offset - middle
        covariance = (own[:, None] * centred).T @ centred / (1.0 - own @ own)
        covariance = covariance * np.outer(in_use, in_use)
        covariance += np.diag(~in_use) + np.diag(1e-6 * np.diag(covariance))
        try:
            tril[i, k] = np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            continue
        mean[i, k] = mine[np.argmax(own)] + middle
        mean[i, k] -= np.where(is_angle, turn * np.round(mean[i, k] / turn), 0.0)
        share[i, k] = _SHARE
    parts = (on_device(part, z.dtype) for part in (mean, tril, share))
    return _fit_spare(targets, mixtures, *parts)


def _num_effective(z: np.ndarray, weight: np.ndarray) -> float:
    """How many draws a weighted list with repetitions counts for."""
    if len(z) == 0:
        return 0.0
    weight = weight / weight.max()
    kish = float(weight.sum() ** 2 / (weight**2).sum())
    return min(kish, float(len(np.unique(z, axis=0))))
