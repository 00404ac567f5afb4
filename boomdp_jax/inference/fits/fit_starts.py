"""Where fits start: guesses, prior draws, and fits of structures with one slot less."""

from typing import Any, NamedTuple

import jax
import numpy as np

from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.inference.fits.fit import (
    Fits,
    FitSettings,
    Host,
    best_of_each,
    make_fits,
)
from boomdp_jax.inference.fits.fit_groups import FitGroups
from boomdp_jax.inference.fits.seeds import random_starts, seed_coordinates
from boomdp_jax.inference.likelihoods.target import StructureTarget


class Guesses(NamedTuple):
    """Where constraints would have to be, on the host; see `seeds`."""

    z: np.ndarray
    """`[object, dim]`."""
    has: np.ndarray

    @classmethod
    def of(cls, targets: StructureTarget) -> "Guesses":
        """Solve for them."""
        z, has = _guesses(targets)
        return cls(np.asarray(z, float), np.asarray(has))


@QuickCompile
def _guesses(targets: StructureTarget):
    likelihood: Any = targets.log_likelihood
    return jax.vmap(lambda x: seed_coordinates(x.coordinates, x.data.steps))(likelihood)


def first_fits(
    rng: np.random.Generator,
    targets: StructureTarget,
    guesses: Guesses,
    settings: FitSettings,
) -> Fits:
    """The best of many starts of every structure, before any climb."""
    host = Host.of(targets)
    draws = np.stack(
        [
            random_starts(rng, z, has, host.period, settings.num_draws)
            for z, has in zip(*guesses, strict=True)
        ]
    )
    draws = np.where(host.in_use[None, :, None], draws[:, None], 0.0)
    has_start = np.ones(draws.shape[:2], bool)
    return _best_draws(targets, draws, has_start, settings.num_starts)


def grown_fits(
    rng: np.random.Generator,
    targets: StructureTarget,
    guesses: Guesses,
    fits: Fits,
    settings: FitSettings,
    lack: np.ndarray | None = None,
) -> Fits:
    """Starts of every structure from the best fits of structures with one slot less.

    The slot's own coordinates come from the prior, or from a guess. A structure that no
    smaller one leads to starts from its own best fit, and so does the first start of
    every structure.

    Args:
        rng: source of randomness.
        targets: stacked along a leading object axis.
        guesses: where constraints would have to be.
        fits: of all structures.
        settings: how many starts.
        lack: as for `climb`; a structure that lacks more, and that none leads to which
            does not, has no starts. None: all have.
    """
    num_objects, num_structures = targets.structures.shape[:2]
    host = Host.of(targets)
    best = best_of_each(fits, num_structures, 1)
    z = best.z.reshape(num_objects, num_structures, -1)
    num = settings.num_draws
    draws = np.empty((num_objects, num_structures, num, z.shape[-1]))
    parents = [_parents(targets, k) for k in range(num_structures)]
    for i in range(num_objects):
        block = random_starts(rng, guesses.z[i], guesses.has[i], host.period, num)
        for k, parent in enumerate(parents):
            chosen = parent[np.arange(num) % len(parent)]
            is_new = host.in_use[k] & ~host.in_use[chosen]
            draws[i, k] = np.where(is_new, block, z[i, chosen])
            draws[i, k, 0] = z[i, k]
    is_worth = np.ones((num_objects, num_structures), bool)
    if lack is not None:
        groups = FitGroups(best.index, best.structure, num_objects, num_structures)
        is_worth = groups.is_worth(best.value, lack).reshape(is_worth.shape)
    has_start = is_worth | np.stack([is_worth[:, p].any(axis=1) for p in parents], 1)
    return _best_draws(targets, draws, has_start, settings.num_starts)


def _parents(targets: StructureTarget, structure: int) -> np.ndarray:
    """Structures with one slot less; the structure itself if there are none."""
    structures = np.asarray(targets.structures[0])
    active = structures[structure]
    less = active[None] & ~np.eye(len(active), dtype=bool)[active]
    found = np.flatnonzero((structures[:, None] == less[None]).all(-1).any(-1))
    return found if found.size else np.array([structure])


def _best_draws(
    targets: StructureTarget, draws: np.ndarray, has_start: np.ndarray, num: int
) -> Fits:
    """The best few of the draws of each structure `[object, structure, draw, dim]`."""
    num_draws, dim = draws.shape[2:]
    index, structure = (np.repeat(part, num_draws) for part in np.nonzero(has_start))
    fits = make_fits(targets, index, structure, draws[has_start].reshape(-1, dim))
    return best_of_each(fits, draws.shape[1], num)
