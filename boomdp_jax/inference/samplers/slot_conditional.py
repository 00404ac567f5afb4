r"""What a mixture says of one slot's coordinates when all others are known.

A Student component with squared scale $LL^\top$, precision $\Lambda$ and $\nu$ degrees
of freedom splits into kept coordinates $K$ and a block $B$. With the offset $\delta$
from its mean, $v = \Lambda \delta_K$ and $\Lambda_{BB} = CC^\top$,

$$q_K = \delta_K^\top v - |C^{-1} v_B|^2, \qquad
  z_B \mid z_K \sim t_{\nu + d_K}\Big(m_B - \Lambda_{BB}^{-1} v_B,\;
  \frac{\nu + q_K}{\nu + d_K} \Lambda_{BB}^{-1}\Big).$$

Components are weighed by their marginal density of $z_K$. Ding (2016), On the
conditional distribution of the multivariate t distribution.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, IntScalar
from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.core.random_numbers import Noise, pick
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.laplace_mixture import (
    LaplaceMixture,
    coordinate_log_prior,
    is_in_cell,
    prior_draw,
    student_log_peak,
)


@full_precision
def sample_slot(
    noise: Noise,
    target: StructureTarget,
    mixture: LaplaceMixture,
    structure: IntScalar,
    z: Float[Array, " dim"],
    block: Bool[Array, " dim"],
    prior_share: float,
) -> tuple[Float[Array, " dim"], BoolScalar]:
    """Draw one slot's coordinates given those of all other slots.

    Two parts: with probability `prior_share` from the prior, else from the mixture's
    conditional (always from the prior where the structure has no component).

    Args:
        noise: random numbers; the first two choices are used.
        target: says which coordinates are angles.
        mixture: whose conditional is drawn from.
        structure: structure that has the slot.
        z: coordinates; those of the block are ignored.
        block: the slot's coordinates.
        prior_share: probability of the first part, in (0, 1].

    Returns:
        The coordinates with the block filled in, and whether the draw counts (an angle
        may have fallen out of its component's cell).
    """
    mixture = mixture.of_structure(structure)
    split = _split(target, mixture, structure, z, block)
    component = pick(split.log_weight, noise.choice[0])
    student = block & mixture.is_student[component]
    freedom = split.freedom[component]
    spread = split.scale[component] * jnp.sqrt(freedom / noise.chi_square(freedom))
    offset = split.shift[component] + spread * (
        mixture.block_whitening[component].T @ jnp.where(student, noise.normal, 0.0)
    )
    is_prior = noise.choice[1] < _prior_share(mixture, structure, prior_share)
    drawn = jnp.where(
        student & ~is_prior,
        target.wrap(mixture.mean[component] + offset),
        prior_draw(noise, target),
    )
    is_inside = is_prior | is_in_cell(target, offset, student)
    return jnp.where(block, drawn, z), is_inside


@full_precision
def slot_log_density(
    target: StructureTarget,
    mixture: LaplaceMixture,
    structure: IntScalar,
    z: Float[Array, " dim"],
    block: Bool[Array, " dim"],
    prior_share: float,
) -> FloatScalar:
    """Log-density with which `sample_slot` draws the block of `z`; 0 if it is empty."""
    mixture = mixture.of_structure(structure)
    split = _split(target, mixture, structure, z, block)
    log_prior = coordinate_log_prior(target, z)
    student = block[None] & mixture.is_student
    deviation = jnp.where(student, mixture.offset(target, z) - split.shift, 0.0)
    whitened = jnp.einsum("cij,ci->cj", mixture.block_tril, deviation)
    distance = jnp.sum(whitened**2, axis=-1) / split.scale**2
    num_block = jnp.sum(student, axis=-1)
    each = (
        student_log_peak(split.freedom, num_block)
        + split.log_precision
        - num_block * jnp.log(split.scale)
        - 0.5 * (split.freedom + num_block) * jnp.log1p(distance / split.freedom)
        + jnp.sum(
            jnp.where(block[None] & mixture.from_prior, log_prior[None], 0.0), axis=-1
        )
    )
    share = _prior_share(mixture, structure, prior_share)
    conditional = logsumexp(split.log_weight + each)
    prior = jnp.sum(jnp.where(block, log_prior, 0.0))
    return jnp.logaddexp(jnp.log1p(-share) + conditional, jnp.log(share) + prior)


class _Split(NamedTuple):
    """Each component's conditional of a block; depends on the kept coordinates only."""

    log_weight: Float[Array, " component"]
    shift: Float[Array, "component dim"]
    scale: Float[Array, " component"]
    freedom: Int[Array, " component"]
    log_precision: Float[Array, " component"]
    """Half the log-determinant of the block's precision."""


@full_precision
def _split(
    target: StructureTarget,
    mixture: LaplaceMixture,
    structure: IntScalar,
    z: Float[Array, " dim"],
    block: Bool[Array, " dim"],
) -> _Split:
    nu = mixture.degrees_of_freedom
    student = mixture.is_student & block[None]
    kept = jnp.where(block[None], 0.0, mixture.offset(target, z))
    whitened = jnp.einsum("cij,cj->ci", mixture.whitening, kept)
    v = jnp.einsum("cji,cj->ci", mixture.whitening, whitened)
    half = jnp.einsum("cij,cj->ci", mixture.block_whitening, jnp.where(student, v, 0.0))
    shift = -jnp.einsum("cji,cj->ci", mixture.block_whitening, half)
    distance = jnp.maximum(jnp.sum(whitened**2 - half**2, axis=-1), 0.0)
    num_kept = jnp.sum(mixture.is_student & ~block[None], axis=-1)
    diagonal = jnp.diagonal(mixture.block_tril, axis1=-2, axis2=-1)
    log_precision = jnp.sum(jnp.where(student, jnp.log(diagonal), 0.0), axis=-1)
    diagonal = jnp.diagonal(mixture.scale_tril, axis1=-2, axis2=-1)
    log_prior = jnp.where(block, 0.0, coordinate_log_prior(target, z))
    log_marginal = (
        student_log_peak(nu, num_kept)
        - jnp.sum(jnp.log(diagonal), axis=-1)
        - log_precision
        - 0.5 * (nu + num_kept) * jnp.log1p(distance / nu)
        + jnp.sum(jnp.where(mixture.from_prior, log_prior[None], 0.0), axis=-1)
    )
    log_weight = jnp.where(
        mixture.structure == structure, mixture.log_weight + log_marginal, -jnp.inf
    )
    total = logsumexp(log_weight)
    return _Split(
        log_weight=log_weight - jnp.where(jnp.isfinite(total), total, 0.0),
        shift=jnp.where(student, shift, 0.0),
        scale=jnp.sqrt((nu + distance) / (nu + num_kept)),
        freedom=nu + num_kept,
        log_precision=log_precision,
    )


def _prior_share(
    mixture: LaplaceMixture, structure: IntScalar, prior_share: float
) -> FloatScalar:
    return jnp.where(mixture.has_structure(structure), prior_share, 1.0)
