"""A posterior by NUTS: the numbers of a scene in which a structure holds."""

import functools

import numpy as np
from jaxtyping import Bool

from boomdp_jax.core.arrays import Key
from boomdp_jax.core.history import History
from boomdp_jax.inference.blocks.fixed_structure import Structure
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.inference.under_numpyro.nuts_chains import sample_model
from boomdp_jax.inference.under_numpyro.one_structure import infer_numbers
from boomdp_jax.physics.scene_spec import SceneSpec


def run_nuts(
    key: Key,
    spec: SceneSpec,
    history: History,
    *,
    structure: Structure | Bool[np.ndarray, " slot"] | None = None,
    num_warmup: int = 300,
    num_samples: int = 500,
    num_chains: int = 4,
    progress_bar: bool = False,
) -> Posterior:
    """Posterior over the numbers of one structure, noise scales included.

    The likelihood is that of equations 1 to 3 of the paper: single steps, from readings
    that are taken as exact. Where what a step starts from is as noisy as what it ends
    at, `infer` with method `rj`, which treats states as latent, is the better judge.

    Args:
        key: random key.
        spec: the scene: outlines, what is known, what may exist.
        history: recorded transitions. An empty one gives the prior.
        structure: constraints that exist besides the known ones, as in `make_model`;
            `{}` for none. Default: where the scene leaves structures open, the most
            probable one, by fits and importance sampling; a note in the diagnostics
            names it, and where its probability is under 0.95 they are not ok, since
            the draws then leave out what may well be true.
        num_warmup: iterations of each chain that adapt and are thrown away.
        num_samples: iterations of each chain that are kept.
        num_chains: chains.
        progress_bar: show stages on standard error.

    Returns:
        Draws of all chains, all with this structure. There is no evidence. Diagnostics
        tell of R-hat, effective sample size and `divergences`, by name of the number.

    Raises:
        ValueError: a structure that the scene does not allow, a history of another
            number of bodies, or counts that are not positive.
    """
    counts = {"num_warmup": num_warmup, "num_samples": num_samples}
    for name, count in (counts | {"num_chains": num_chains}).items():
        if count < 1:
            raise ValueError(f"{name}: expected at least 1, got {count}")
    sampler = functools.partial(
        sample_model,
        num_chains=num_chains,
        num_warmup=num_warmup,
        num_samples=num_samples,
    )
    return infer_numbers(
        key,
        spec,
        history,
        sampler,
        method="nuts",
        structure=structure,
        progress_bar=progress_bar,
    )
