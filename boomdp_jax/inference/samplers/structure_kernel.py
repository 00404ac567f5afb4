"""The structure sampler as a NumPyro kernel: chains, summary, resuming."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro.infer.mcmc import MCMCKernel
from numpyro.util import is_prng_key

from boomdp_jax.core.arrays import FloatScalar, IntScalar, Key
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.samplers.moves import MOVES, evaluate
from boomdp_jax.inference.samplers.structure_chain import (
    ChainInfo,
    ChainSettings,
    ChainState,
    init,
    step,
)


class Sample(NamedTuple):
    """Where a chain stands.

    Not a dictionary: of that, NumPyro's summary would show only what it has before
    `postprocess`.
    """

    structure: IntScalar
    z: Float[Array, "*chain dim"]


class KernelState(NamedTuple):
    """State of one chain, or of several with a leading axis, as NumPyro carries it."""

    sample: Sample
    log_density: FloatScalar
    chain: ChainState
    info: ChainInfo
    """Counts since warm-up ended (or, while in it, since it began)."""
    warmup_left: IntScalar
    rng_key: Key


class StructureKernel(MCMCKernel):
    """Reversible jumps by Laplace mixture for `numpyro.infer.MCMC`.

    `get_samples()` returns `structure` and `z`, or what `postprocess` makes of them;
    `extra_fields` may name `log_density`, `info.accepted`, `chain.walk_step.log_step`
    and so on. To run many objects in one program, use `run_chains` instead.

    Args:
        target: the density to sample.
        mixture: the proposal, with a component for every structure of positive prior.
        settings: how often to make each move.
        postprocess: function of a sample's dictionary, for instance from coordinates to
            physical numbers.

    Raises:
        ValueError: a structure of positive prior that no component belongs to.
    """

    def __init__(
        self,
        target: StructureTarget,
        mixture: LaplaceMixture,
        settings: ChainSettings | None = None,
        *,
        postprocess: Callable[[dict[str, Array]], Any] | None = None,
    ):
        weight = np.asarray(mixture.structure_log_weight(target))
        lacking = np.flatnonzero(np.isneginf(weight) & (target.log_prior > -jnp.inf))
        if lacking.size:
            raise ValueError(
                f"mixture: expected a component for every structure, got none for "
                f"structures {lacking.tolist()}; see add_prior_components"
            )
        self.target = target
        self.mixture = mixture
        self.settings = ChainSettings() if settings is None else settings
        self._postprocess = postprocess
        # NumPyro initialises anew whenever a kernel lacks this, even to resume.
        self._sample_fn = self._iterate

    @property
    def sample_field(self) -> str:
        """Which field holds the draw."""
        return "sample"

    @property
    def default_fields(self) -> tuple[str, ...]:
        """Which fields are collected unless asked otherwise."""
        return ("sample", "log_density")

    def init(
        self,
        rng_key: Array,
        num_warmup: int,
        init_params: dict[str, Array] | None = None,
        model_args: tuple = (),
        model_kwargs: dict | None = None,
    ) -> KernelState:
        """Start one chain for each key.

        Args:
            rng_key: one key, or one for each chain.
            num_warmup: iterations that adapt step sizes.
            init_params: `structure` and `z` to start at; default: drawn.
            model_args: not used.
            model_kwargs: not used.
        """
        start = eqx.filter_jit(self._start)
        if is_prng_key(rng_key):
            return start(rng_key, num_warmup, init_params)
        return jax.vmap(
            lambda key, params: start(key, num_warmup, params),
            in_axes=(0, None if init_params is None else 0),
        )(rng_key, init_params)

    def sample(
        self, state: KernelState, model_args: tuple, model_kwargs: dict | None
    ) -> KernelState:
        """Make one iteration of every chain in the state."""
        if is_prng_key(state.rng_key):
            return self._sample_fn(state)
        return jax.vmap(self._sample_fn)(state)

    def postprocess_fn(self, model_args: tuple, model_kwargs: dict | None) -> Callable:
        """What turns a sample into what `get_samples` returns."""
        postprocess = self._postprocess or (lambda sample: sample)
        return lambda sample: postprocess(sample._asdict())

    def get_diagnostics_str(self, state: KernelState) -> str:
        """Acceptance so far, for the progress bar."""
        proposed = np.asarray(state.info.proposed)
        accepted = np.asarray(state.info.accepted)
        shares = accepted.sum(-1) / np.maximum(proposed.sum(-1), 1)
        parts = [
            f"{name} {share:.2f}"
            for name, share, num in zip(MOVES, shares, proposed.sum(-1), strict=True)
            if num
        ]
        return f"structure {int(state.sample.structure)}, accepted: " + ", ".join(parts)

    def _start(
        self, key: Key, num_warmup: int, init_params: dict[str, Array] | None
    ) -> KernelState:
        key, init_key = jax.random.split(key)
        chain = init(init_key, self.target, self.mixture, self.settings)
        if init_params is not None:
            structure = init_params["structure"].astype(chain.point.structure.dtype)
            z = jnp.where(self.target.in_use(structure), init_params["z"], 0.0)
            point = evaluate(self.target, self.mixture, structure, self.target.wrap(z))
            chain = eqx.tree_at(lambda chain: chain.point, chain, point)
        zeros = jnp.zeros((len(MOVES), 2), jnp.int32)
        return KernelState(
            sample=Sample(chain.point.structure, chain.point.z),
            log_density=chain.point.log_density,
            chain=chain,
            info=ChainInfo(zeros, zeros),
            warmup_left=jnp.asarray(num_warmup, jnp.int32),
            rng_key=key,
        )

    def _iterate(self, state: KernelState) -> KernelState:
        key, step_key = jax.random.split(state.rng_key)
        chain, info = step(
            step_key,
            state.chain,
            self.target,
            self.mixture,
            self.settings,
            is_adapting=state.warmup_left > 0,
        )
        totals = jax.tree.map(
            lambda total, count: jnp.where(state.warmup_left == 1, 0, total + count),
            state.info,
            info,
        )
        return KernelState(
            sample=Sample(chain.point.structure, chain.point.z),
            log_density=chain.point.log_density,
            chain=chain,
            info=totals,
            warmup_left=jnp.maximum(state.warmup_left - 1, 0),
            rng_key=key,
        )
