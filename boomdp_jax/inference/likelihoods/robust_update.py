r"""A filter's update by readings with Student-t noise, one channel after the other.

A Student-t of scale σ and ν degrees of freedom is a normal of variance $\sigma^2 /
\lambda$ with $\lambda \sim \mathrm{Gamma}(\nu/2, \nu/2)$. With the integral over λ as a
sum over nodes of weights $w_k$, a reading with innovation e, of a state known with
variance p, has the density and leaves the state with the moments of a mixture:

$$p(e) = \sum_k w_k N(e; 0, S_k), \quad S_k = p + \sigma^2 / \lambda_k, \quad
  \hat x = K \bar g e, \quad P = P - K K^T (\bar g - e^2 \mathrm{var}(g)),$$

where K is the state's covariance with the channel and mean and variance of $g_k =
S_k^{-1}$ are over the nodes given e. The mixture is replaced by a normal of its moments
(West (1981), Robust sequential approximate Bayesian estimation; Roth et al. (2017),
Robust Bayesian filtering and smoothing using Student's t distribution).
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.core.lanes import in_lanes

DEGREES_OF_FREEDOM = 4.0
"""Of readings with outliers: a variance exists, and ten sds are nothing unheard of."""

# Nodes lie evenly in log λ, where the rule of equal steps converges geometrically; the
# lowest are for readings a thousand scales off.
_NODE_STEP, _LOWEST_LOG, _HIGHEST_LOG = 0.8, -15.2, 2.4
_LOG_TURN = math.log(2.0 * math.pi)


class RobustUpdate(NamedTuple):
    """What a reading does to a state."""

    shift: Float[Array, " channel"]
    """Of the mean."""
    covariance: Float[Array, "channel channel"]
    log_density: FloatScalar
    variance: Float[Array, " channel"]
    """Normal noise with it would have the same gain; outliers have a large one."""


def scale_nodes(freedom: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes λ and the logarithms of their weights, which sum to one.

    Args:
        freedom: degrees of freedom ν.
    """
    log_node = np.arange(_LOWEST_LOG, _HIGHEST_LOG + 1e-9, _NODE_STEP)
    half, node = 0.5 * freedom, np.exp(log_node)
    log_weight = half * log_node - half * node + half * np.log(half)
    log_weight = log_weight - math.lgamma(half)
    return node, log_weight - np.logaddexp.reduce(log_weight)


def correct_robustly(
    covariance: Float[Array, "channel channel"],
    miss: Float[Array, " channel"],
    mask: Float[Array, " channel"],
    variance: Float[Array, " channel"],
    freedom: float,
) -> RobustUpdate:
    """Take a reading whose channels have independent Student-t noise.

    Args:
        covariance: of the state.
        miss: reading minus state.
        mask: one where a channel was read.
        variance: squared scale of the noise.
        freedom: its degrees of freedom.

    Returns:
        The update. The order of the channels matters little.
    """
    arrays = (covariance, miss, mask, variance)
    return RobustUpdate(*in_lanes(_correct, *arrays, static=(freedom,)))


def _correct(freedom: float, covariance, miss, mask, variance) -> tuple:
    """With lanes as the last axis of everything."""
    node, log_weight = scale_nodes(freedom)
    inverse = jnp.asarray(1.0 / node, miss.dtype)[:, None]
    log_weight = jnp.asarray(log_weight, miss.dtype)[:, None]

    def one_channel(c, carry):
        covariance, shift, density, effective = carry
        column = covariance[:, c]
        known = jnp.maximum(column[c], 0.0)
        spread = known[None] + variance[c][None] * inverse
        error = miss[c] - shift[c]
        log_each = log_weight - 0.5 * (
            jnp.log(spread) + _LOG_TURN + (error**2)[None] / spread
        )
        total = jax.scipy.special.logsumexp(log_each, axis=0)
        share = jnp.exp(log_each - total[None])
        mean = jnp.sum(share / spread, axis=0)
        scatter = jnp.sum(share * (1.0 / spread - mean[None]) ** 2, axis=0)
        shift = shift + column * (mask[c] * mean * error)[None]
        shrink = mask[c] * (mean - error**2 * scatter)
        covariance = covariance - column[:, None] * column[None] * shrink[None, None]
        wide = jnp.where(mask[c] > 0, 1.0 / mean - known, variance[c])
        return covariance, shift, density + mask[c] * total, effective.at[c].set(wide)

    carry = (covariance, jnp.zeros_like(miss), jnp.zeros_like(miss[0]), variance)
    found = jax.lax.fori_loop(0, miss.shape[0], one_channel, carry)
    covariance, shift, density, effective = found
    return shift, covariance, density, effective
