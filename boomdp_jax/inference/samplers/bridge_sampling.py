r"""Evidence from draws of the posterior and of a proposal, by the optimal bridge.

With draws $x_i$ from a normalised density $q$ and $y_j$ from $p / Z$, iterate

$$Z = \frac{N_1^{-1} \sum_i w(x_i) / (s_1 Z + s_2 w(x_i))}
           {N_2^{-1} \sum_j 1 / (s_1 Z + s_2 w(y_j))}, \quad w = p / q,$$

with $s_k$ the shares of draws, has the least variance of all bridges. Meng and Wong
(1996), Simulating ratios of normalizing constants via a simple identity, eq. 4.1; error
after Frühwirth-Schnatter (2004), Estimating marginal likelihoods for mixture and Markov
switching models using bridge sampling techniques, eq. 18.

It needs only the ratios that importance sampling has computed anyway, and stays right
where importance weights have heavy tails.
"""

from typing import NamedTuple

import numpy as np

_MAX_ITERATIONS, _TOLERANCE = 200, 1e-10


class Bridge(NamedTuple):
    """An estimate of log Z and its standard error."""

    log_evidence: float
    error: float


def bridge_evidence(
    log_ratio_proposal: np.ndarray,
    log_ratio_posterior: np.ndarray,
    *,
    posterior_size: float | None = None,
) -> Bridge:
    """Estimate log Z.

    Args:
        log_ratio_proposal: log p - log q at draws from q; minus infinity where p is 0.
        log_ratio_posterior: the same at draws from the posterior.
        posterior_size: effective number of the posterior's draws; default: all.

    Returns:
        The estimate; minus infinity with an infinite error without draws of both that
        p reaches.
    """
    first = np.asarray(log_ratio_proposal, float)
    second = np.asarray(log_ratio_posterior, float)
    second = second[np.isfinite(second)]
    if not np.any(np.isfinite(first)) or second.size == 0:
        return Bridge(-np.inf, np.inf)
    size = float(second.size if posterior_size is None else posterior_size)
    share_1 = first.size / (first.size + size)
    share_2 = 1.0 - share_1
    shift = np.median(second)
    ratio_1, ratio_2 = _exp(first - shift), _exp(second - shift)
    value = max(float(ratio_1.mean()), np.finfo(float).tiny)
    for _ in range(_MAX_ITERATIONS):
        top = np.mean(ratio_1 / (share_1 * value + share_2 * ratio_1))
        bottom = np.mean(1.0 / (share_1 * value + share_2 * ratio_2))
        before, value = value, top / bottom
        if abs(value - before) <= _TOLERANCE * value:
            break
    f_1 = (ratio_1 / value) / (share_1 + share_2 * ratio_1 / value)
    f_2 = 1.0 / (share_1 + share_2 * ratio_2 / value)
    variance = f_1.var() / f_1.mean() ** 2 / first.size + f_2.var() / (
        f_2.mean() ** 2 * size
    )
    return Bridge(float(np.log(value) + shift), float(np.sqrt(variance)))


def _exp(log_ratio: np.ndarray) -> np.ndarray:
    """Ratios about the posterior's median, kept finite."""
    return np.exp(np.clip(log_ratio, -700.0, 700.0))
