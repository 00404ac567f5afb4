"""Weights of mixtures and evidence of structures, for batches of objects."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.one_by_one import one_by_one
from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.core.random_numbers import Noise, host_noise
from boomdp_jax.inference.likelihoods.evaluate import evaluate_points
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.importance_evidence import (
    ImportanceEvidence,
    draws_of_noise,
    weigh_draws,
)
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.samplers.mixture_building import refine_weights

# Share of the weight that stays spread evenly, over components of modes times priors as
# well: what draws have missed so far must be found by others.
_FLOOR = 0.3


@QuickCompile
def _draw(offset, noise, targets: StructureTarget, mixtures: LaplaceMixture):
    return one_by_one(draws_of_noise, offset, noise, targets, mixtures)


@QuickCompile
def _weigh_all(targets: StructureTarget, draws, log_density):
    return jax.vmap(weigh_draws)(targets, draws, log_density)


def weigh(
    rng: np.random.Generator,
    targets: StructureTarget,
    mixtures: LaplaceMixture,
    num_draws: int,
    evaluate: Callable[..., Array],
    is_asked: np.ndarray | None = None,
) -> ImportanceEvidence:
    """Draw from mixtures and weigh the draws.

    Args:
        rng: source of randomness.
        targets: stacked along a leading object axis.
        mixtures: one of each object.
        num_draws: of each object.
        evaluate: as `evaluate_each`.
        is_asked: objects whose draws are weighed, `[object]`; None: all. Of the others
            nothing that is returned means anything.
    """
    num_objects = targets.structures.shape[0]
    noise = batch_noise(rng, targets, mixtures, num_draws)
    offset = on_device(rng.random(num_objects), noise.normal.dtype)
    draws = _draw(offset, noise, targets, mixtures)
    where = draws.structure, draws.z
    return _weigh_all(
        targets, draws, evaluate_asked(evaluate, targets, *where, is_asked)
    )


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
    is_asked: np.ndarray | None = None,
) -> Float[Array, "object point"]:
    """Log-densities of as many points of every object.

    Args:
        targets: with a `FilteredLikelihood`, stacked along a leading object axis.
        structure: of each point.
        z: coordinates of each point.
        is_asked: objects whose points are evaluated, `[object]`; None: all. Those of
            the others get minus infinity.
    """
    num_objects, num = structure.shape
    asked = np.arange(num_objects) if is_asked is None else np.flatnonzero(is_asked)
    found = evaluate_points(
        targets,
        np.repeat(asked, num),
        np.asarray(structure)[asked].reshape(-1),
        np.asarray(z)[asked].reshape(len(asked) * num, -1),
    )
    out = np.full((num_objects, num), -np.inf)
    out[asked] = found.log_density.reshape(len(asked), num)
    return on_device(out)


def evaluate_asked(
    evaluate: Callable[..., Array],
    targets: StructureTarget,
    structure: Int[Array, "object point"],
    z: Float[Array, "object point dim"],
    is_asked: np.ndarray | None,
) -> Float[Array, "object point"]:
    """The same by any such function, which is told of a choice where there is one."""
    if is_asked is None or np.all(is_asked):
        return evaluate(targets, structure, z)
    return evaluate(targets, structure, z, is_asked)


@QuickCompile
def _take_over(is_asked, new, old):
    def one(a, b):
        return jnp.where(is_asked.reshape(-1, *(1 for _ in a.shape[1:])), a, b)

    return jax.tree.map(one, new, old)


def taken_over(is_asked: np.ndarray, new: Any, old: Any) -> Any:
    """What is new of the objects asked, what was known of the others.

    Args:
        is_asked: `[object]`.
        new: tree of arrays with a leading object axis.
        old: such a tree.
    """
    if np.all(is_asked):
        return new
    return _take_over(on_device(is_asked, bool), new, old)


@QuickCompile
def _refine_all(targets: StructureTarget, mixtures: LaplaceMixture, evidence):
    return one_by_one(
        lambda t, m, e: refine_weights(
            t, m, e.structure, e.z, e.log_weight, floor=_FLOOR
        ),
        *(targets, mixtures, evidence),
    )


def refine(
    targets: StructureTarget, mixtures: LaplaceMixture, evidence: ImportanceEvidence
) -> LaplaceMixture:
    """Set the weights of components to their shares of weighted draws."""
    return _refine_all(targets, mixtures, evidence)
