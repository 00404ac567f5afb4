r"""Evidence of every structure by importance sampling from the mixture.

With draws $(k_i, z_i) \sim q$ and weights $w_i = p(k_i, z_i) / q(k_i, z_i)$,
$\pi_k Z_k \approx N^{-1} \sum_i w_i [k_i = k]$, whatever the mixture's weights are.
One batched call, no chain: the cross-check of the jump sampler, and its equal where the
effective sample size is large.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.core.arrays import FloatScalar, Key
from boomdp_jax.core.random_numbers import Noise, draw_noise
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture

# Draws that are worked at side by side.
_AT_A_TIME = 256


class ImportanceEvidence(eqx.Module):
    """Evidence and probability of every structure, and the weighted draws behind."""

    log_evidence: Float[Array, " structure"]
    """Log of the likelihood averaged over a structure's prior."""
    evidence_error: Float[Array, " structure"]
    """Standard error of `log_evidence`, one over the root of its sample size."""
    probability: Float[Array, " structure"]
    probability_error: Float[Array, " structure"]
    """Standard error of `probability`."""
    effective_sample_size: FloatScalar
    """Of all draws together, Kish's."""
    structure_sample_size: Float[Array, " structure"]
    """Effective sample size within each structure."""
    structure: Int[Array, " draw"]
    z: Float[Array, "draw dim"]
    log_density: Float[Array, " draw"]
    log_weight: Float[Array, " draw"]
    """Normalised over all draws."""


class ImportanceDraws(eqx.Module):
    """Draws from a mixture, one or many, not yet weighed."""

    structure: Int[Array, "*batch"]
    z: Float[Array, "*batch dim"]
    log_proposal: Float[Array, "*batch"]
    is_inside: Bool[Array, "*batch"]
    """False where a draw fell outside; it has no weight."""


@eqx.filter_jit
def importance_evidence(
    key: Key,
    target: StructureTarget,
    mixture: LaplaceMixture,
    num_draws: int,
    *,
    even_share: float = 0.5,
    chunk_size: int = 1024,
) -> ImportanceEvidence:
    """Estimate the evidence of every structure.

    Args:
        key: random key.
        target: the density.
        mixture: where to draw from.
        num_draws: draws of all structures together.
        even_share: as in `importance_draws`.
        chunk_size: likelihoods evaluated at once; bounds memory.

    Returns:
        The estimates. An effective sample size under some hundreds, or one far below
        the number of draws, means that the mixture misses part of the posterior: the
        errors are then too small as well.
    """
    draws = importance_draws(key, target, mixture, num_draws, even_share=even_share)
    log_density = jax.lax.map(
        lambda inputs: target.log_density(*inputs),
        (draws.structure, draws.z),
        batch_size=min(chunk_size, num_draws),
    )
    return weigh_draws(target, draws, log_density)


def importance_draws(
    key: Key,
    target: StructureTarget,
    mixture: LaplaceMixture,
    num_draws: int,
    *,
    even_share: float = 0.5,
) -> ImportanceDraws:
    """Draw from a mixture, in proportion to the weights of its components.

    Args:
        key: random key.
        target: the density.
        mixture: where to draw from.
        num_draws: draws of all structures together.
        even_share: share of draws that is spread evenly over structures, so that the
            evidence of an improbable structure is known too.

    Returns:
        Draws, with the density that they were drawn from.
    """
    offset_key, draw_key = jax.random.split(key)
    keys = jax.random.split(draw_key, num_draws)
    noise = jax.vmap(
        lambda key: draw_noise(key, target.dim, mixture.degrees_of_freedom)
    )(keys)
    offset = jax.random.uniform(offset_key)
    return draws_of_noise(offset, noise, target, mixture, even_share=even_share)


def draws_of_noise(
    offset: FloatScalar,
    noise: Noise,
    target: StructureTarget,
    mixture: LaplaceMixture,
    *,
    even_share: float = 0.5,
) -> ImportanceDraws:
    """The same from random numbers drawn already.

    Components are drawn systematically, which never does worse than drawing them
    independently; the errors that `weigh_draws` states are those of independent draws.

    Args:
        offset: uniform over (0, 1); shifts the choice of components.
        noise: one of each draw.
        target: the density.
        mixture: where to draw from.
        even_share: as in `importance_draws`.
    """
    mixture = spread_evenly(target, mixture, even_share)
    num_draws = noise.choice.shape[0]
    position = (jnp.arange(num_draws) + offset) / num_draws
    cumulative = jnp.cumsum(jnp.exp(mixture.log_weight))
    component = jnp.searchsorted(cumulative / cumulative[-1], position, side="right")
    component = jnp.minimum(component, mixture.num_components - 1)

    def draw(noise: Noise, component: Int[Array, ""]) -> ImportanceDraws:
        drawn = mixture.sample_component(noise, target, component)
        log_proposal = mixture.log_density(target, drawn.structure, drawn.z)
        return ImportanceDraws(drawn.structure, drawn.z, log_proposal, drawn.is_inside)

    # Every draw needs the components of its structure, which for all draws at once are
    # much to hold.
    return jax.lax.map(
        lambda each: draw(*each), (noise, component), batch_size=_AT_A_TIME
    )


def weigh_draws(
    target: StructureTarget, draws: ImportanceDraws, log_density: Float[Array, " draw"]
) -> ImportanceEvidence:
    """Turn draws and the target's log-density there into evidence and probabilities."""
    num_draws = draws.structure.shape[0]
    is_possible = draws.is_inside & (log_density < jnp.inf)
    log_density = jnp.where(is_possible, log_density, -jnp.inf)
    log_weight = log_density - draws.log_proposal
    log_weight = jnp.where(jnp.isnan(log_weight), -jnp.inf, log_weight)
    total = logsumexp(log_weight)
    normalised = log_weight - jnp.where(jnp.isfinite(total), total, 0.0)
    weight = jnp.exp(normalised)
    is_of = draws.structure[None] == jnp.arange(target.num_structures)[:, None]
    weights = jnp.where(is_of, weight[None], 0.0)
    probability = jnp.sum(weights, axis=-1)
    square = jnp.sum(weights**2, axis=-1)
    size = probability**2 / jnp.where(square > 0, square, 1.0)
    deviation = weight[None] * (is_of - probability[:, None])
    log_joint = logsumexp(jnp.where(is_of, log_weight[None], -jnp.inf), axis=-1)
    log_prior = jnp.where(target.log_prior > -jnp.inf, target.log_prior, 0.0)
    return ImportanceEvidence(
        log_evidence=log_joint - jnp.log(num_draws) - log_prior,
        evidence_error=jnp.sqrt(
            jnp.maximum(1.0 / jnp.where(size > 0, size, 0.0) - 1.0 / num_draws, 0.0)
        ),
        probability=probability,
        probability_error=jnp.sqrt(jnp.sum(deviation**2, axis=-1)),
        effective_sample_size=1.0 / jnp.sum(weight**2),
        structure_sample_size=size,
        structure=draws.structure,
        z=draws.z,
        log_density=log_density,
        log_weight=normalised,
    )


def spread_evenly(
    target: StructureTarget, mixture: LaplaceMixture, even_share: float
) -> LaplaceMixture:
    """Raise improbable structures, keeping the proportions within each.

    Args:
        target: says which structures exist.
        mixture: whose weights are changed.
        even_share: share of the weight that all structures with components get alike.
    """
    of_structure = mixture.structure_log_weight(target)
    num_present = jnp.sum(of_structure > -jnp.inf)
    within = mixture.log_weight - jnp.where(
        mixture.log_weight > -jnp.inf, of_structure[mixture.structure], 0.0
    )
    log_weight = jnp.logaddexp(
        mixture.log_weight + jnp.log1p(-even_share),
        within + jnp.log(even_share) - jnp.log(num_present),
    )
    return eqx.tree_at(lambda new: new.log_weight, mixture, log_weight)
