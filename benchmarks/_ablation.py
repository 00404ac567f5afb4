"""The same chains with three proposals of jumps between structures."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpyro.diagnostics import effective_sample_size

from boomdp_jax.core.history import History
from boomdp_jax.core.random_numbers import host_generator
from boomdp_jax.inference.blocks.block import make_block, stack_blocks
from boomdp_jax.inference.fits.find_modes import find_modes
from boomdp_jax.inference.fits.fit import FitSettings
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.adapt_mixture import adapt_mixtures
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture, make_mixture
from boomdp_jax.inference.samplers.mixture_building import laplace_mixture
from boomdp_jax.inference.samplers.moves import MOVES
from boomdp_jax.inference.samplers.structure_chain import ChainSettings, run_chains
from boomdp_jax.inference.samplers.structure_draws import start_mixtures
from boomdp_jax.inference.samplers.weighing import evaluate_each
from boomdp_jax.physics.scene_spec import SceneSpec

PROPOSALS = ("births from the prior", "one fit of each structure", "adapted mixture")
_NUM_CHAINS, _NUM_WARMUP, _NUM_DRAWS = 4, 100, 1024


class Ablation(NamedTuple):
    """How chains with one proposal went."""

    acceptance: float
    """Of jumps to another structure or to other numbers."""
    share: float
    """Of draws that have the true structure."""
    size: float
    """Effective draws of the log-density."""


def ablate(
    key: jax.Array,
    spec: SceneSpec,
    history: History,
    truth: SceneSpec,
    *,
    num_samples: int,
) -> dict[str, Ablation]:
    """Run the same chains with each proposal, on the filter with fixed gains."""
    fit_key, draw_key, run_key = jax.random.split(key, 3)
    block = make_block(spec, (0,), history)
    found = find_modes(fit_key, stack_blocks([block]), FitSettings())
    target = jax.tree.map(lambda leaf: leaf[0], found.targets)
    modes = jax.tree.map(lambda leaf: leaf[0], found.modes)
    num_each = modes.z.shape[0] // target.num_structures
    first = jax.tree.map(lambda leaf: leaf[::num_each], modes)
    adapted, _ = adapt_mixtures(
        host_generator(draw_key),
        found.targets,
        start_mixtures(found.targets, found.modes),
        _NUM_DRAWS,
        evaluate_each,
    )
    mixtures = {
        PROPOSALS[0]: _from_prior(target),
        PROPOSALS[1]: laplace_mixture(
            target, first.structure, first.z, first.precision, first.log_density
        ),
        PROPOSALS[2]: jax.tree.map(lambda leaf: leaf[0], adapted),
    }
    right = _true_structure(block, target, truth)
    return {
        name: _run(run_key, target, mixture, right, num_samples)
        for name, mixture in mixtures.items()
    }


def _from_prior(target: StructureTarget) -> LaplaceMixture:
    """Every structure as often as the prior has it, with numbers from the prior."""
    num, dim = target.num_structures, target.dim
    return make_mixture(
        target,
        jnp.arange(num),
        jnp.zeros((num, dim)),
        jnp.broadcast_to(jnp.eye(dim), (num, dim, dim)),
        target.log_prior,
        from_prior=jnp.ones((num, dim), bool),
    )


@eqx.filter_jit
def _chains(key, target, mixture, num_samples: int):
    # No walks are left out: they are the same for all three.
    return run_chains(
        key,
        target,
        mixture,
        num_chains=_NUM_CHAINS,
        num_warmup=_NUM_WARMUP,
        num_samples=num_samples,
        settings=ChainSettings(num_changes=0),
    )


def _run(key, target, mixture, right: int, num_samples: int) -> Ablation:
    draws, info = _chains(key, target, mixture, num_samples)
    jump = MOVES.index("jump")
    proposed = np.asarray(info.proposed)[:, jump].sum()
    accepted = np.asarray(info.accepted)[:, jump].sum()
    value = np.asarray(draws.log_density, float)
    return Ablation(
        acceptance=float(accepted / max(proposed, 1)),
        share=float(np.mean(np.asarray(draws.structure) == right)),
        size=float(effective_sample_size(value)) if np.ptp(value) > 0 else 0.0,
    )


def _true_structure(block, target, truth: SceneSpec) -> int:
    """Index of the truth among the structures."""
    params = truth.params()
    active = [
        bool(np.any(np.asarray(getattr(params, slot.kind).active)))
        for slot in block.layout.slots
    ]
    same = np.all(np.asarray(target.structures) == np.array(active), axis=1)
    return int(np.argmax(same))
