r"""No-U-turn sampling of the numbers of one structure, started at its fitted modes.

Hoffman and Gelman (2014), The No-U-Turn Sampler, by NumPyro, on `ObjectModel`. The
posterior is a needle: anchors are known to a ten-thousandth of their prior width. From
NumPyro's default mass matrix, the identity, every path then takes hundreds of steps,
and its regularised estimate stays too wide; here the Laplace approximation gives the
first one, and the draws of all chains together the second: ten to thirty steps a path.

Every chain is a call of one compiled program for each fifty iterations, and chains go
side by side on threads or devices (`core.spread`). Measured on a pinned box, 100 rows,
4 chains of 500 iterations on a busy core: NumPyro's vectorised chains compile for 30 s
and run for 13 s, since every chain waits for the longest path; chains by themselves
take 18 s to compile, once for all blocks of a layout, and run for one second.

Prefer it to reversible jumps where the structure is known and the posterior far from
normal; it says nothing about which constraints exist.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro.infer.hmc import hmc
from numpyro.infer.util import potential_energy

from boomdp_jax.core.arrays import Key
from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.core.spread import Program, run_each
from boomdp_jax.inference.blocks.block import stack_blocks
from boomdp_jax.inference.blocks.model_sites import Site
from boomdp_jax.inference.fits.find_modes import find_single_step_modes
from boomdp_jax.inference.fits.fit import FitSettings
from boomdp_jax.inference.hypotheses.prior import NOISE_GROUPS
from boomdp_jax.inference.likelihoods.one_step import (
    NOISE_SHAPE,
    OneStepLikelihood,
    draw_noise,
)
from boomdp_jax.inference.samplers.chain_diagnostics import (
    ChainDiagnostics,
    judge_series,
)
from boomdp_jax.inference.samplers.mixture_building import laplace_mixture
from boomdp_jax.inference.under_numpyro.numpyro_model import ObjectModel
from boomdp_jax.inference.under_numpyro.one_structure import ModelDraws

# Iterations of one compiled call; what is left over at the end is thrown away.
_CHUNK = 50
# Draws that the Laplace approximation counts for when covariances are pooled.
_LAPLACE_DRAWS = 20.0
# Divergent share of the draws above which they are not to be trusted. Paths that cross
# between sticking and slipping meet a kink and diverge now and then: 0.1 to 0.4 % of
# the draws of pinned boxes, 0.7 % of those of a wheeled one, with R-hat under 1.01.
_MAX_DIVERGENT = 0.01


class Start(NamedTuple):
    """Unconstrained points to start from, and the covariance to move with."""

    point: dict[str, Array]
    covariance: Float[Array, "number number"]


def sample_model(
    key: Key,
    model: ObjectModel,
    *,
    num_chains: int = 4,
    num_warmup: int = 300,
    num_samples: int = 500,
    report: Callable[[str], None] = lambda stage: None,
) -> ModelDraws:
    """Draw from the posterior of a model of one block.

    Args:
        key: random key.
        model: of one block, with a noise scale per group.
        num_chains: chains, each started at a draw from the fitted mixture.
        num_warmup: iterations of each that adapt; half with the Laplace approximation's
            mass matrix, half with that of the first half's draws.
        num_samples: iterations of each that are kept.
        report: called with the name of each stage as it begins.

    Returns:
        Draws and verdict.
    """
    fit_key, start_key, *run_keys = jax.random.split(key, 4)
    report("fitting")
    start = fitted_start(fit_key, start_key, model, num_chains)
    half = max(num_warmup // 2, 1)
    report("warming up")
    chains = _Chains(model, half)
    keys = [jax.random.split(run_key, num_chains) for run_key in run_keys]
    states = chains.begin(keys[0], start)
    states, warm = chains.iterate(states, start.covariance, half)
    flat = _flatten(model, warm.z)[:, half // 2 :]
    covariance = _pooled(flat, start.covariance)
    points = _stack([state.z for state in states])
    states = chains.begin(keys[1], Start(jax.device_put(points), covariance))
    states, _ = chains.iterate(states, covariance, half)
    report("sampling")
    _, drawn = chains.iterate(states, covariance, num_samples)
    return _collect(model, drawn)


@full_precision
def _pooled(
    drawn: Float[Array, "chain draw number"], laplace: Float[Array, "number number"]
) -> Float[Array, "number number"]:
    """Covariance of all chains' draws together, each chain's about their mean."""
    within = drawn - jnp.mean(drawn, axis=1, keepdims=True)
    scatter = jnp.einsum("cdi,cdj->ij", within, within)
    num = drawn.shape[0] * drawn.shape[1]
    covariance = scatter + _LAPLACE_DRAWS * laplace
    return covariance / (num + _LAPLACE_DRAWS)


class _Drawn(NamedTuple):
    """What is kept of every iteration."""

    z: dict[str, Array]
    potential_energy: Array
    diverging: Array
    num_steps: Array


def site_order(model: ObjectModel) -> tuple[str, ...]:
    """Names of sites in the order in which a flat vector holds their numbers."""
    noise = tuple(f"noise.{group}" for group in NOISE_GROUPS)
    return (*(site.name for site in model.sites[0]), *noise)


def _flatten(model: ObjectModel, point: dict[str, Array]) -> Array:
    """All numbers of points `[chain, draw, ...]` along the last axis."""
    parts = [point[name] for name in site_order(model)]
    return jnp.concatenate([p.reshape(*p.shape[:2], -1) for p in parts], axis=-1)


def _hmc(model: ObjectModel, start: Start, num_warmup: int, key: Key) -> tuple:
    """A NUTS state at a start, and the function that makes one iteration."""
    potential = functools.partial(potential_energy, model, (), {})
    init, sample = hmc(potential_fn=potential, algo="NUTS")
    order = site_order(model)
    state = init(
        start.point,
        num_warmup,
        inverse_mass_matrix={order: start.covariance},
        dense_mass=[order],
        adapt_mass_matrix=False,
        rng_key=key,
    )
    return state, sample


class _Static(NamedTuple):
    """What a model is besides its arrays, hashable, and the length of the warm-up."""

    treedef: Any
    leaves: tuple
    num_warmup: int

    def model(self, arrays: Any) -> ObjectModel:
        """The whole model."""
        static = jax.tree.unflatten(self.treedef, self.leaves)
        return eqx.combine(arrays, static, is_leaf=lambda leaf: leaf is None)


class _Chains:
    """All chains of a model, each a call of the same program for so many iterations."""

    def __init__(self, model: ObjectModel, num_warmup: int):
        self._arrays, static = eqx.partition(model, eqx.is_array)
        leaves, treedef = jax.tree.flatten(static, is_leaf=lambda leaf: leaf is None)
        self._begin, self._advance = _programs(
            _Static(treedef, tuple(leaves), num_warmup)
        )

    def begin(self, keys: Array, start: Start) -> list[Any]:
        """States of all chains; the start's points have a leading chain axis."""
        # Words of keys are plain arrays, which go to any device.
        words = np.asarray(jax.random.key_data(keys))
        points = jax.tree.map(np.asarray, start.point)
        inputs = [
            (words[chain], jax.tree.map(lambda leaf, chain=chain: leaf[chain], points))
            for chain in range(len(words))
        ]
        return run_each(self._begin, (self._arrays, start.covariance), inputs)

    def iterate(
        self, states: list[Any], covariance: Array, num: int
    ) -> tuple[list[Any], _Drawn]:
        """At least `num` iterations; the last `num` of them are returned."""
        parts = []
        shared = (self._arrays, covariance)
        for _ in range(-(-num // _CHUNK)):
            found = run_each(self._advance, shared, [(state,) for state in states])
            states = [state for state, _ in found]
            parts.append(_stack([drawn for _, drawn in found]))
        drawn = jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *parts)
        return states, jax.tree.map(lambda leaf: jax.device_put(leaf[:, -num:]), drawn)


def _stack(trees: list[Any]) -> Any:
    """Trees of arrays as one with a leading axis."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


@functools.lru_cache(maxsize=16)
def _programs(static: _Static) -> tuple[Program, Program]:
    """What begins a chain, and what takes it some iterations further."""

    # NumPyro's own products, those with the mass matrix, are made in here.
    @full_precision
    def begin(shared: tuple, words: Array, point: dict[str, Array]) -> Any:
        arrays, covariance = shared
        start = Start(point, covariance)
        return _hmc(static.model(arrays), start, static.num_warmup, words)[0]

    @full_precision
    def advance(shared: tuple, state: Any) -> tuple[Any, _Drawn]:
        arrays, covariance = shared
        # NumPyro's iteration is set up by making a start; the compiler drops it.
        start = Start(state.z, covariance)
        model = static.model(arrays)
        _, sample = _hmc(model, start, static.num_warmup, state.rng_key)

        def iterate(state: Any, _: None) -> tuple[Any, _Drawn]:
            state = sample(state)
            return state, _Drawn(
                state.z, state.potential_energy, state.diverging, state.num_steps
            )

        return jax.lax.scan(iterate, state, None, length=_CHUNK)

    return Program(begin), Program(advance)


def fitted_start(
    fit_key: Key, start_key: Key, model: ObjectModel, num_chains: int
) -> Start:
    """Draws from the fitted modes' mixture, and the heaviest mode's covariance.

    Args:
        fit_key: random key, for the fits.
        start_key: random key, for the draws.
        model: of one block, with a noise scale per group.
        num_chains: draws.

    Returns:
        Unconstrained numbers by site with a leading chain axis; the covariance has
        them in the order of `site_order`.
    """
    (block,) = model.blocks
    targets = stack_blocks([block])
    modes = find_single_step_modes(fit_key, targets, FitSettings())
    modes = jax.tree.map(lambda leaf: leaf[0], modes)
    return _start_at(start_key, model, modes, num_chains)


@eqx.filter_jit
@full_precision
def _start_at(key: Key, model: ObjectModel, modes: Any, num_chains: int) -> Start:
    target = model.blocks[0].target
    tracked: Any = target.log_likelihood
    likelihood = OneStepLikelihood(tracked.coordinates, tracked.data.steps)
    mixture = laplace_mixture(
        target, modes.structure, modes.z, modes.precision, modes.log_density
    )

    def one(key: Key) -> dict[str, Array]:
        z_key, noise_key = jax.random.split(key)
        z = mixture.sample(z_key, target).z
        statistics = likelihood.statistics(z, target.structures[0])
        noise = draw_noise(noise_key, statistics, model.noise_scale)
        point = {site.name: _unconstrained(site, z) for site in model.sites[0]}
        for group, scale in zip(NOISE_GROUPS, noise.T, strict=True):
            point[f"noise.{group}"] = jnp.log(scale)
        return point

    points = jax.lax.map(one, jax.random.split(key, num_chains))
    factor = mixture.scale_tril[jnp.argmax(mixture.log_weight)]
    order = jnp.asarray([c for site in model.sites[0] for c in site.coordinates], int)
    scale = [jnp.ravel(site.scale) for site in model.sites[0]]
    rows = jnp.concatenate([*scale, jnp.zeros(0)])[:, None] * factor[order]
    count = likelihood.statistics(modes.z[0], target.structures[0]).num
    # The logarithm of a scale whose inverse square follows a gamma distribution.
    spread = 0.25 / (NOISE_SHAPE + 0.5 * count.T.ravel())
    covariance = jax.scipy.linalg.block_diag(rows @ rows.T, jnp.diag(spread))
    return Start(points, covariance)


def _unconstrained(site: Site, z: Float[Array, " dim"]) -> Array:
    """A site's number on the scale that NumPyro samples: before its link's inverse."""
    part = z[jnp.asarray(site.coordinates)].reshape(site.loc.shape)
    return site.loc + site.scale * part


def coordinates_of(model: ObjectModel, point: dict[str, Array]) -> Array:
    """Coordinates `[chain, draw, dim]` of unconstrained numbers by site."""
    (block,) = model.blocks
    shape = next(iter(point.values())).shape[:2]
    z = jnp.zeros((*shape, block.layout.dim))
    for site in model.sites[0]:

        def standard(value: Array, site: Site = site) -> Array:
            return jnp.ravel((value - site.loc) / site.scale)

        value = jax.vmap(jax.vmap(standard))(point[site.name])
        z = z.at[..., jnp.asarray(site.coordinates)].set(value)
    return jax.vmap(jax.vmap(block.target.wrap))(z)


def _collect(model: ObjectModel, drawn: _Drawn) -> ModelDraws:
    """Coordinates, noise scales and verdict from unconstrained draws."""
    noise = [jnp.exp(drawn.z[f"noise.{group}"]) for group in NOISE_GROUPS]
    num_divergent = int(jnp.sum(drawn.diverging))
    return ModelDraws(
        z=coordinates_of(model, drawn.z),
        noise_scale=jnp.stack(noise, axis=-1),
        log_density=-drawn.potential_energy,
        diagnostics=_diagnose(model, drawn, num_divergent),
        log_evidence=float("nan"),
        extras={"divergences": num_divergent},
    )


def _diagnose(
    model: ObjectModel, drawn: _Drawn, num_divergent: int
) -> ChainDiagnostics:
    """Verdict on the chains, every number by its name."""
    series = {"log_density": -np.asarray(drawn.potential_energy)}
    links = {site.name: site.link for site in model.sites[0]}
    for name, value in drawn.z.items():
        columns = np.asarray(value, float).reshape(*value.shape[:2], -1)
        for place in range(columns.shape[-1]):
            label = name if value.ndim == 2 else f"{name}[{place}]"
            column = columns[..., place]
            if links.get(name) == "half_turn":
                series[f"cos 2 {label}"] = np.cos(2.0 * column)
                series[f"sin 2 {label}"] = np.sin(2.0 * column)
            else:
                series[label] = column
    num_each = drawn.potential_energy.shape[1]
    r_hat, size, reasons = judge_series(series, num_each)
    if num_divergent > _MAX_DIVERGENT * drawn.diverging.size:
        reasons.append(f"{num_divergent} of {drawn.diverging.size} draws diverged")
    return ChainDiagnostics(not reasons, reasons, r_hat, size, {})
