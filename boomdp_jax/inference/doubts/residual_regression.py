r"""Is there a further linear law in innovations? Bayes factors, and whiteness.

Near the truth whitened innovations are linear in everything: at a hypothesis with
coordinates z and without a law,

$$u \approx -J \delta z - X c + e, \qquad e \sim N(0, 1),$$

with J and X their derivatives by coordinates and by the coefficients of a law. What
coordinates would absorb is no evidence for the law, so J is in both models, with the
prior of z as further rows. With $\tilde X$, $\tilde u$ the rest of X and u after J, and
the unit-information prior $c \sim N(0, n (\tilde X^T \tilde X)^{-1})$ of n rows
(Zellner 1986; Kass and Wasserman 1995),

$$\log B = \tfrac12 \tfrac{n}{1 + n} W - \tfrac p2 \log(1 + n), \qquad
  W = b^T V^{-1} b, \quad b = \tilde X^T \tilde u, \quad V = \tilde X^T \tilde X.$$

Real noise is neither normal nor white: a few kicks of a foot that sticks and slips may
lie along any law. So W is the lesser of this and of the one in which the spread of c is
what leaving out one stretch of rows after the other makes of it (the jackknife; Künsch
1989, The jackknife and the bootstrap for general stationary observations, for blocks of
rows): a law has to hold all along.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from boomdp_jax.inference.posteriors.summary import CHANNELS

# A law of which less than this share of its length is left is one of the model's own.
_LEAST_LEFT = 1e-3
# Stretches of rows that are left out in turn, and the share of a law's information
# below which nothing is known without one.
_NUM_STRETCHES, _LEAST_SHARE = 20, 1e-3
# Lags over which whiteness is judged, and pairs of readings that each needs.
_NUM_LAGS, _LEAST_PAIRS = 4, 12
# Mean square of standardised innovations from which their whiteness is judged.
_LEAST_SQUARE = 0.5
_GROUPS = ((0, 1), (2,), (3, 4), (5,))


class LawFit(NamedTuple):
    """What innovations say of a law."""

    coefficient: Float[np.ndarray, " part"]
    sd: Float[np.ndarray, " part"]
    log_bayes_factor: float
    """Of the model with the law against the one without."""
    steady: float = -np.inf
    """The same by how alike coefficients of different stretches of rows are, alone."""


class Absorbed(NamedTuple):
    """Innovations and what coordinates may explain of them."""

    rest: Float[np.ndarray, " entry"]
    """Innovations without it."""
    basis: Float[np.ndarray, "entry coordinate"]
    """Orthonormal."""
    num_rows: int
    """Steps; what follows them in `entry` is the prior's."""


def absorb(
    innovation: Float[np.ndarray, "time reading"],
    jacobian: Float[np.ndarray, "coordinate time reading"],
    z: Float[np.ndarray, " coordinate"],
    has_prior: np.ndarray,
) -> Absorbed:
    """Take from innovations what the model's own numbers would explain.

    Args:
        innovation: whitened.
        jacobian: of them by the coordinates in use.
        z: coordinates in use.
        has_prior: which of them are standard normal a priori; the others are free.
    """
    num_rows = len(innovation)
    columns = jacobian.reshape(len(jacobian), -1).T
    columns = np.concatenate([columns, np.diag(has_prior.astype(float))])
    target = np.concatenate([innovation.reshape(-1), np.where(has_prior, z, 0.0)])
    left, length, _ = np.linalg.svd(columns, full_matrices=False)
    basis = left[:, length > 1e-6 * np.max(length, initial=0.0)]
    return Absorbed(target - basis @ (basis.T @ target), basis, num_rows)


def fit_law(
    known: Absorbed, derivative: Float[np.ndarray, "part time reading"]
) -> LawFit | None:
    """Weigh a law against none.

    Args:
        known: innovations, and what the model's numbers would absorb.
        derivative: of the innovations by the law's coefficients.

    Returns:
        Its coefficients and their evidence; None where the model has the law already,
        or where it has no effect.
    """
    num_parts, num_rows = derivative.shape[:2]
    columns = derivative.reshape(num_parts, -1).T
    length = np.sqrt(np.sum(columns**2, axis=0))
    if not np.all(np.isfinite(length)) or np.any(length == 0):
        return None
    unit = columns / length
    inside = known.basis[: len(unit)]
    prior = -known.basis[len(unit) :] @ (inside.T @ unit)
    left = np.concatenate([unit - inside @ (inside.T @ unit), prior])
    information = left.T @ left
    if np.linalg.eigvalsh(information)[0] < _LEAST_LEFT**2:
        return None
    score = left.T @ known.rest
    covariance = np.linalg.inv(information)
    best = covariance @ score
    plain = float(best @ score)
    precision = _jackknife(left[: len(unit)], known.rest[: len(unit)], num_rows)
    steady = float(best @ precision @ best)
    return LawFit(
        coefficient=-best / length,
        sd=np.sqrt(np.diagonal(covariance)) / length,
        log_bayes_factor=unit_information(min(plain, steady), num_parts, num_rows),
        steady=unit_information(steady, num_parts, num_rows),
    )


def unit_information(wald: float, num_parts: int, num_rows: int) -> float:
    """Log Bayes factor of coefficients with a prior worth one row.

    Args:
        wald: their square in their own spread, or twice the log-likelihood they gain.
        num_parts: how many.
        num_rows: that tell of them.
    """
    size = float(num_rows)
    return 0.5 * wald * size / (1 + size) - 0.5 * num_parts * float(np.log1p(size))


def _jackknife(
    left: Float[np.ndarray, "entry part"],
    rest: Float[np.ndarray, " entry"],
    num_rows: int,
) -> Float[np.ndarray, "part part"]:
    """Precision of coefficients by leaving out one stretch of rows after the other."""
    entries = len(left) // num_rows
    stretch = np.arange(num_rows) * _NUM_STRETCHES // num_rows
    if num_rows < _NUM_STRETCHES:
        stretch = np.arange(num_rows)
    stretch = np.repeat(stretch, entries)
    size, num = left.shape[1], int(stretch[-1]) + 1
    information, score = np.zeros((num, size, size)), np.zeros((num, size))
    np.add.at(information, stretch, left[:, :, None] * left[:, None, :])
    np.add.at(score, stretch, left * rest[:, None])
    whole, total = information.sum(axis=0), score.sum(axis=0)
    # With next to nothing of a law left, it could have any size.
    least = _LEAST_SHARE * np.trace(whole) / size * np.eye(size)
    without = np.linalg.solve(whole - information + least, (total - score)[..., None])[
        ..., 0
    ]
    change = without - np.linalg.solve(whole + least, total)
    spread = (num - 1) / num * change.T @ change
    return np.linalg.inv(spread + 1e-12 * np.trace(spread) * np.eye(size) + 1e-300)


def whiteness(
    innovation: Float[np.ndarray, "time channel"],
    counts: Float[np.ndarray, "time channel"],
    track: Int[np.ndarray, " time"],
) -> float | None:
    """Probability of innovations as correlated as these if they are white.

    The portmanteau of Ljung and Box (1978), each lag's covariance by its own spread
    (Escanciano and Lobato 2009), which noise that is not normal needs.

    Args:
        innovation: of one channel group.
        counts: one where it was read.
        track: which track a row belongs to; pairs lie within one.

    Returns:
        The p-value; None with too few readings.
    """
    total, num = 0.0, 0
    value = np.where(counts > 0, innovation, 0.0)
    for lag in range(1, _NUM_LAGS + 1):
        both = (counts[lag:] > 0) & (counts[:-lag] > 0)
        both &= (track[lag:] == track[:-lag])[:, None]
        pairs = (value[lag:] * value[:-lag])[both]
        spread = float(np.sum(pairs**2))
        if len(pairs) < _LEAST_PAIRS or spread == 0:
            continue
        total += float(np.sum(pairs)) ** 2 / spread
        num += 1
    return _chi_square_tail(total, num) if num else None


def correlation(
    innovation: Float[np.ndarray, "time channel"],
    counts: Float[np.ndarray, "time channel"],
    track: Int[np.ndarray, " time"],
) -> float:
    """Of innovations with those one reading before; arguments as of `whiteness`."""
    value = np.where(counts > 0, innovation, 0.0)
    pairs = (value[1:] * value[:-1])[track[1:] == track[:-1]]
    return float(np.sum(pairs)) / max(float(np.sum(value**2)), 1e-300)


def _chi_square_tail(value: float, num: int) -> float:
    """Probability of a chi-square of `num` degrees of freedom beyond a value."""
    half = 0.5 * value
    tail = math.erfc(math.sqrt(half)) if num % 2 else math.exp(-half)
    for k in range(num % 2 or 2, num, 2):
        tail += math.exp(0.5 * k * math.log(half) - half - math.lgamma(0.5 * k + 1.0))
    return min(tail, 1.0)


def white_by_body(
    innovation: Float[np.ndarray, "time body 6"],
    counts: Float[np.ndarray, "time body 6"],
    track: Int[np.ndarray, " time"],
) -> tuple[list[dict[str, float]], tuple[dict[str, float], ...]]:
    """Whiteness and correlation of every body's readings, by channel group.

    Args:
        innovation: whitened, of the readings that end each step.
        counts: one where something was read.
        track: which run each step belongs to.

    Returns:
        Of each body p-values, and correlations of innovations one after the other.
    """
    found, correlated = [], []
    for body in range(innovation.shape[1]):
        each, both = {}, {}
        for name, group in zip(CHANNELS, _GROUPS, strict=True):
            channels = list(group)
            error = innovation[:, body, channels]
            seen = counts[:, body, channels]
            # Readings that are better than they are taken to be need not be white.
            is_full = np.sum(error**2) > _LEAST_SQUARE * np.sum(seen)
            value = whiteness(error, seen, track) if is_full else None
            if value is not None:
                each[name] = value
                both[name] = correlation(error, seen, track)
        found.append(each)
        correlated.append(both)
    return found, tuple(correlated)
