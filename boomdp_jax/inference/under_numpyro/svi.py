r"""A normal approximation of the numbers of one structure, fitted by the ELBO.

NumPyro's `SVI` with a guide that is normal over all unconstrained numbers, written in
units of the Laplace approximation: $u = \hat u + L (m + T \epsilon)$ with the fitted
mode $\hat u$ and its covariance $L L^T$, and m and T learnt from zero and one. Without
that the posterior is a needle that no step size suits. Hoffman et al. (2013),
Stochastic variational inference; Kucukelbir et al. (2017), ADVI.

Prefer it to `laplace` where the posterior is skewed about its mode; it has one mode and
one structure, and says in its diagnostics what that costs.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float
from numpyro.distributions import constraints
from numpyro.infer import SVI, Trace_ELBO, init_to_value
from numpyro.infer.autoguide import AutoContinuous
from numpyro.infer.util import constrain_fn, potential_energy

from boomdp_jax.core.arrays import Key
from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.core.history import History
from boomdp_jax.inference.blocks.fixed_structure import Structure
from boomdp_jax.inference.hypotheses.prior import NOISE_GROUPS
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.inference.samplers.chain_diagnostics import ChainDiagnostics
from boomdp_jax.inference.under_numpyro.numpyro_model import ObjectModel
from boomdp_jax.inference.under_numpyro.nuts_chains import (
    coordinates_of,
    fitted_start,
    site_order,
)
from boomdp_jax.inference.under_numpyro.one_structure import ModelDraws, infer_numbers
from boomdp_jax.physics.scene_spec import SceneSpec

# Draws behind every gradient of the ELBO, and its steps: enough that doubling either
# changes the ELBO of a pinned box by less than 0.05 nats.
_NUM_PARTICLES, _RATE, _LAST_RATE = 8, 0.03, 0.001
# Share of draws that importance weights must leave for the fit to stand.
_LEAST_SHARE = 0.1


class WhitenedNormal(AutoContinuous):
    """A normal guide in units of a covariance that is known roughly.

    Args:
        model: a NumPyro model without discrete sites.
        center: unconstrained numbers, flattened in the order of the sites' names.
        scale_tril: Cholesky factor of their rough covariance.
        init_loc_fn: constrained values to start at.
    """

    def __init__(
        self,
        model: Callable,
        center: Float[Array, " number"],
        scale_tril: Float[Array, "number number"],
        *,
        init_loc_fn: Callable,
    ):
        self.center = center
        self.scale_tril = scale_tril
        super().__init__(model, init_loc_fn=init_loc_fn)

    def _get_posterior(self) -> dist.Distribution:
        """The normal distribution of all unconstrained numbers."""
        num = self.center.shape[0]
        zeros, identity = jnp.zeros(num), jnp.eye(num)
        loc: Any = numpyro.param(f"{self.prefix}_loc", zeros)
        tril: Any = numpyro.param(
            f"{self.prefix}_scale_tril",
            identity,
            constraint=constraints.softplus_lower_cholesky,
        )
        return self._normal(loc, tril)

    def get_posterior(self, params: dict[str, Array]) -> dist.Distribution:
        """The same at given parameters of the guide."""
        prefix = self.prefix
        return self._normal(params[f"{prefix}_loc"], params[f"{prefix}_scale_tril"])

    @full_precision
    def _normal(self, loc: Array, tril: Array) -> dist.Distribution:
        return dist.MultivariateNormal(
            self.center + self.scale_tril @ loc, scale_tril=self.scale_tril @ tril
        )


def run_svi(
    key: Key,
    spec: SceneSpec,
    history: History,
    *,
    structure: Structure | Bool[np.ndarray, " slot"] | None = None,
    num_steps: int = 600,
    num_samples: int = 500,
    num_chains: int = 4,
    progress_bar: bool = False,
) -> Posterior:
    """Normal approximation of the numbers of one structure, noise scales included.

    The likelihood is that of single steps, as for `run_nuts`.

    Args:
        key: random key.
        spec: the scene: outlines, what is known, what may exist.
        history: recorded transitions. An empty one gives the prior, as far as it is
            normal on the scales that are sampled: that of noise is not.
        structure: constraints that exist besides the known ones, as in `make_model`;
            default: the most probable ones, as in `run_nuts`.
        num_steps: gradient steps.
        num_samples: draws for each of `num_chains`.
        num_chains: groups of draws, so that the posterior has the form of others.
        progress_bar: show stages on standard error.

    Returns:
        Independent draws. Their evidence is the ELBO weighed by importance: the log of
        the mean weight; diagnostics hold `elbo`, the lower bound, and are not ok where
        the weights leave under a tenth of the draws.

    Raises:
        ValueError: as in `run_nuts`.
    """
    counts = {"num_steps": num_steps, "num_samples": num_samples}
    for name, count in (counts | {"num_chains": num_chains}).items():
        if count < 1:
            raise ValueError(f"{name}: expected at least 1, got {count}")
    sampler = functools.partial(
        fit_normal, num_steps=num_steps, num_samples=num_samples, num_chains=num_chains
    )
    return infer_numbers(
        key,
        spec,
        history,
        sampler,
        method="svi",
        structure=structure,
        progress_bar=progress_bar,
    )


def fit_normal(
    key: Key,
    model: ObjectModel,
    *,
    num_steps: int = 600,
    num_samples: int = 500,
    num_chains: int = 4,
    report: Callable[[str], None] = lambda stage: None,
) -> ModelDraws:
    """Fit the guide to a model of one block, and draw from it.

    Args:
        key: random key.
        model: of one block, with a noise scale per group.
        num_steps: gradient steps.
        num_samples: draws for each of `num_chains`.
        num_chains: groups of draws.
        report: called with the name of each stage as it begins.

    Returns:
        Draws and verdict.
    """
    fit_key, start_key, run_key, draw_key = jax.random.split(key, 4)
    report("fitting")
    start = fitted_start(fit_key, start_key, model, 1)
    point = jax.tree.map(lambda leaf: leaf[0], start.point)
    covariance = _by_name(model, point, start.covariance)
    report("raising the ELBO")
    num_draws = num_chains * num_samples
    fitted = _fit(run_key, draw_key, model, point, covariance, num_steps, num_draws)
    drawn, log_density, log_weight, elbo = fitted
    drawn = jax.tree.map(
        lambda leaf: leaf.reshape(num_chains, num_samples, *leaf.shape[1:]), drawn
    )
    log_weight = np.asarray(log_weight, float)
    total = np.logaddexp.reduce(log_weight)
    size = float(1.0 / np.sum(np.exp(log_weight - total) ** 2))
    reasons = []
    if not size >= _LEAST_SHARE * num_draws:
        reasons.append(
            f"normal approximation: weighed by the posterior its {num_draws} draws "
            f"count for {size:.0f}, below {_LEAST_SHARE * num_draws:.0f}"
        )
    noise = [jnp.exp(drawn[f"noise.{group}"]) for group in NOISE_GROUPS]
    return ModelDraws(
        z=coordinates_of(model, drawn),
        noise_scale=jnp.stack(noise, axis=-1),
        log_density=log_density.reshape(num_chains, num_samples),
        diagnostics=ChainDiagnostics(not reasons, reasons, {}, {"weights": size}, {}),
        log_evidence=float(total - np.log(num_draws)),
        extras={"elbo": float(elbo)},
    )


def _by_name(
    model: ObjectModel, point: dict[str, Array], covariance: Array
) -> Float[Array, "number number"]:
    """The covariance with numbers in the order of the sites' names, as guides are."""
    place, places = 0, {}
    for name in site_order(model):
        places[name] = np.arange(place, place + np.size(point[name]))
        place += np.size(point[name])
    order = np.concatenate([places[name] for name in sorted(places)])
    return covariance[order][:, order]


@eqx.filter_jit
@full_precision
def _fit(
    run_key: Key,
    draw_key: Key,
    model: ObjectModel,
    point: dict[str, Array],
    covariance: Array,
    num_steps: int,
    num_draws: int,
) -> tuple[dict[str, Array], Array, Array, Array]:
    """Draws of the fitted guide, log-densities there, log-weights, and the ELBO."""
    center, unpack = ravel_pytree(point)
    guide = WhitenedNormal(
        model,
        center,
        jnp.linalg.cholesky(covariance),
        init_loc_fn=init_to_value(values=constrain_fn(model, (), {}, point)),
    )
    rate = optax.exponential_decay(_RATE, num_steps, _LAST_RATE / _RATE)
    svi = SVI(model, guide, optax.adam(rate), Trace_ELBO(_NUM_PARTICLES))
    state = svi.init(run_key)

    def advance(state: Any, _: None) -> tuple[Any, Array]:
        return svi.stable_update(state)

    state, _ = jax.lax.scan(advance, state, None, length=num_steps)
    posterior: Any = guide.get_posterior(svi.get_params(state))
    flat = jax.vmap(posterior.sample)(jax.random.split(draw_key, num_draws))

    def weigh(number: Array) -> tuple[Array, Array]:
        log_density = -potential_energy(model, (), {}, unpack(number))
        return log_density, log_density - posterior.log_prob(number)

    log_density, log_weight = jax.lax.map(weigh, flat, batch_size=128)
    return jax.vmap(unpack)(flat), log_density, log_weight, jnp.mean(log_weight)
