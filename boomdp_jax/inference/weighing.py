"""Weights of mixtures and evidence of structures, for batches of objects."""

from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.inference.evaluate import evaluate_points
from boomdp_jax.inference.importance_evidence import (
    ImportanceEvidence,
    draws_of_noise,
    weigh_draws,
)
from boomdp_jax.inference.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.mixture_building import refine_weights
from boomdp_jax.inference.noise import Noise, host_noise
from boomdp_jax.inference.target import StructureTarget

# Share of the weight that stays spread evenly, over components of modes times priors as
# well: what draws have missed so far must be found by others.
_FLOOR = 0.3


@QuickCompile
def _draw(offset, noise, targets: StructureTarget, mixtures: LaplaceMixture):
    return jax.vmap(draws_of_noise)(offset, noise, targets, mixtures)


@QuickCompile
def _weigh_all(targets: StructureTarget, draws, log_density):
    return jax.vmap(weigh_draws)(targets, draws, log_density)


def weigh(
    rng: np.random.Generator,
    targets: StructureTarget,
    mixtures: LaplaceMixture,
    num_draws: int,
    evaluate: Callable[..., Array],
) -> ImportanceEvidence:
    """Draw from mixtures and weigh the draws.

    Args:
        rng: source of randomness.
        targets: stacked along a leading object axis.
        mixtures: one of each object.
        num_draws: of each object.
        evaluate: log-densities of as many points of every object.
    """
    num_objects = targets.structures.shape[0]
    noise = batch_noise(rng, targets, mixtures, num_draws)
    offset = on_device(rng.random(num_objects), noise.normal.dtype)
    draws = _draw(offset, noise, targets, mixtures)
    return _weigh_all(targets, draws, evaluate(targets, draws.structure, draws.z))


def batch_noise(
    rng: np.random.Generator,
    targets: StructureTarget,
    mixtures: LaplaceMixture,
    num: int,
) -> Noise:
    """Random numbers for as many proposals of every object."""
    num_objects, dim = targets.slot.shape
    dtype = np.dtype(targets.log_prior.dtype)
    return host_noise(rng, (num_objects, num), dim, mixtures.degrees_of_freedom, dtype)


def evaluate_each(
    targets: StructureTarget,
    structure: Int[Array, "object point"],
    z: Float[Array, "object point dim"],
) -> Float[Array, "object point"]:
    """Log-densities of as many points of every object."""
    num_objects, num = structure.shape
    found = evaluate_points(
        targets,
        np.repeat(np.arange(num_objects), num),
        np.asarray(structure).reshape(-1),
        np.asarray(z).reshape(num_objects * num, -1),
    )
    return on_device(found.log_density.reshape(num_objects, num))


@QuickCompile
def _refine_all(targets: StructureTarget, mixtures: LaplaceMixture, evidence):
    return jax.vmap(
        lambda t, m, e: refine_weights(
            t, m, e.structure, e.z, e.log_weight, floor=_FLOOR
        )
    )(targets, mixtures, evidence)


def refine(
    targets: StructureTarget, mixtures: LaplaceMixture, evidence: ImportanceEvidence
) -> LaplaceMixture:
    """Set the weights of components to their shares of weighted draws."""
    return _refine_all(targets, mixtures, evidence)
