r"""An object's likelihood as a few Gaussian bumps, and their products with a kind's.

With $y = z - \hat z$ a bump is $\exp(g - \tfrac12 |V^T y - t|^2)$, $V$ having a column
for each direction that the data tell of. Times a kind's density $N(y; m, S)$ it
integrates to $e^g |G|^{-1/2} \exp(-\tfrac12 e^T G^{-1} e)$, $G = 1 + V^T S V$,
$e = V^T m - t$, and the product is drawn from by correcting a draw of the kind's
density by a draw of the residual (Matheron's rule; Wilson et al. (2020), Efficiently
Sampling Functions from Gaussian Process Posteriors, section 2). Bumps only propose:
the sampler accepts by the true likelihood.
"""

from typing import NamedTuple

import numpy as np

from boomdp_jax.inference.kinds.coordinates import wrap

# Directions of which the data tell less than this, in units of the prior's precision,
# are left out.
_LEAST_PRECISION = 0.02
_LOG_2_PI = float(np.log(2.0 * np.pi))


class Bumps(NamedTuple):
    """Bumps of one object; a structure may have several."""

    structure: np.ndarray
    """`[bump]`."""
    centre: np.ndarray
    """`[bump, dim]`."""
    factor: np.ndarray
    """V, zero in coordinates that the structure does not use, `[bump, dim, rank]`."""
    residual: np.ndarray
    """t, `[bump, rank]`."""
    log_height: np.ndarray
    """g, `[bump]`."""
    square: np.ndarray
    """Lower triangles of the outer products of the columns of V, by coordinate, `[dim,
    bump * (rank + 1) * rank / 2]`."""

    @property
    def num(self) -> int:
        """How many bumps there are."""
        return len(self.structure)


class Bump(NamedTuple):
    """One of them before all are padded to a common rank."""

    structure: int
    centre: np.ndarray
    factor: np.ndarray
    residual: np.ndarray
    log_height: float


def bump_of_posterior(
    structure: int,
    in_use: np.ndarray,
    period: np.ndarray,
    mean: np.ndarray,
    covariance: np.ndarray,
    log_evidence: float,
) -> Bump:
    """Divide a normal posterior by the prior.

    Args:
        structure: which structure it is of.
        in_use: coordinates of the structure, `[dim]`.
        period: of angles, else 0, `[dim]`.
        mean: of the posterior, `[dim]`.
        covariance: of the posterior, `[dim, dim]`; of the coordinates in use.
        log_evidence: log of the likelihood averaged over the structure's prior.

    Returns:
        The bump whose product with the prior is that posterior, but for directions in
        which the posterior is hardly narrower than the prior.
    """
    used = np.flatnonzero(in_use)
    dim = len(in_use)
    prior = prior_variance(period)
    inner = np.ix_(used, used)
    precision = np.linalg.inv(covariance[inner]) - np.diag(1.0 / prior[used])
    size, direction = np.linalg.eigh(0.5 * (precision + precision.T))
    kept = size > _LEAST_PRECISION
    root = np.sqrt(size[kept])
    factor = np.zeros((dim, int(kept.sum())))
    factor[used] = direction[:, kept] * root
    centre = np.where(in_use, mean, 0.0)
    # The bump alone is centred where posterior and prior pull equally.
    pull = np.where(period > 0, 0.0, centre / prior)
    residual = (factor.T @ pull) / np.maximum(root**2, 1e-300)
    start = np.where(period > 0, 0.0, -centre)
    gap = factor.T @ start - residual
    gram = np.eye(len(root)) + (factor.T * prior) @ factor
    height = log_evidence + 0.5 * np.linalg.slogdet(gram)[1]
    height += 0.5 * gap @ np.linalg.solve(gram, gap)
    return Bump(structure, wrap(centre, period), factor, residual, float(height))


def join_bumps(bumps: list[Bump]) -> Bumps:
    """Pad bumps to a common rank."""
    rank = max((bump.factor.shape[1] for bump in bumps), default=0)

    def pad(array: np.ndarray) -> np.ndarray:
        width = [(0, 0)] * (array.ndim - 1) + [(0, rank - array.shape[-1])]
        return np.pad(array, width)

    factor = np.stack([pad(bump.factor) for bump in bumps])
    rows, columns = np.tril_indices(rank)
    square = factor[:, :, rows] * factor[:, :, columns]
    return Bumps(
        structure=np.array([bump.structure for bump in bumps]),
        centre=np.stack([bump.centre for bump in bumps]),
        factor=factor,
        residual=np.stack([pad(bump.residual) for bump in bumps]),
        log_height=np.array([bump.log_height for bump in bumps]),
        square=np.swapaxes(square, 0, 1).reshape(factor.shape[1], -1),
    )


def prior_variance(period: np.ndarray) -> np.ndarray:
    """Of the ordinary prior of each coordinate."""
    return np.where(period > 0, period**2 / 12.0, 1.0)


def start_of_bumps(
    bumps: Bumps, period: np.ndarray, mean: np.ndarray, variance: np.ndarray
) -> np.ndarray:
    """From the bumps' centres to a kind's mean, `[..., bump, dim]`.

    The shorter way round for angles; zero for angles that the kind leaves open.

    Args:
        bumps: of an object.
        period: of angles, else 0, `[dim]`.
        mean: of a kind's coordinates, `[..., dim]`.
        variance: of the same.
    """
    offset = mean[..., None, :] - bumps.centre
    angles = np.flatnonzero(period > 0)
    if len(angles):
        around = wrap(offset[..., angles], period[angles])
        is_open = variance[..., None, angles] >= period[angles] ** 2 / 12.0 * 0.999
        offset[..., angles] = np.where(is_open, 0.0, around)
    return offset


def log_mass(
    bumps: Bumps, start: np.ndarray, variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Log-integrals of the bumps times a kind's density, `[..., bump]`.

    Args:
        bumps: of an object.
        start: of `start_of_bumps`, `[..., bump, dim]`.
        variance: of the kind's coordinates, `[..., dim]`.

    Returns:
        The integrals, and the Cholesky factor of G, `[..., bump, rank, rank]`.
    """
    rank = bumps.factor.shape[2]
    rows, columns = np.tril_indices(rank)
    # By einsum: a library's product would wake all its threads for so little.
    lower = np.einsum("...d,dk->...k", variance, bumps.square)
    gram = np.zeros((*variance.shape[:-1], bumps.num, rank, rank))
    gram[..., rows, columns] = lower.reshape(*gram.shape[:-2], -1)
    gram += np.eye(rank)
    gap = np.einsum("...md,mdr->...mr", start, bumps.factor) - bumps.residual
    lower = np.linalg.cholesky(gram)
    total = np.zeros(gap.shape[:-1])
    log_volume = np.zeros_like(total)
    white = np.empty_like(gap)
    for row in range(rank):
        known = np.einsum("...r,...r->...", lower[..., row, :row], white[..., :row])
        white[..., row] = (gap[..., row] - known) / lower[..., row, row]
        total += white[..., row] ** 2
        log_volume += np.log(lower[..., row, row])
    return bumps.log_height - log_volume - 0.5 * total, lower


def draw_product(
    factor: np.ndarray,
    residual: np.ndarray,
    lower: np.ndarray,
    start: np.ndarray,
    variance: np.ndarray,
    normal: np.ndarray,
    normal_residual: np.ndarray,
) -> np.ndarray:
    """Points of one bump times a kind's density, relative to the bump's centre.

    Args:
        factor: V of one bump for each point, `[point, dim, rank]`.
        residual: t, `[point, rank]`.
        lower: Cholesky factor of G, `[point, rank, rank]`.
        start: from the bump's centre to the kind's mean, `[point, dim]`.
        variance: of the kind's coordinates, `[point, dim]`.
        normal: standard normal numbers, `[point, dim]`; zeros give the mean.
        normal_residual: the same, `[point, rank]`.

    Returns:
        Offsets, `[point, dim]`; of coordinates that are not in use, whatever.
    """
    first = start + np.sqrt(variance) * normal
    gap = np.einsum("pd,pdr->pr", first, factor) - residual + normal_residual
    gram = np.einsum("prt,pst->prs", lower, lower)
    pull = np.linalg.solve(gram, gap[..., None])[..., 0]
    return first - variance * np.einsum("pdr,pr->pd", factor, pull)


def log_bump(bumps: Bumps, z: np.ndarray, period: np.ndarray) -> np.ndarray:
    """Log of every bump at points `[point, dim]`, `[point, bump]`."""
    offset = wrap(z[:, None, :] - bumps.centre, period)
    gap = np.einsum("pmd,mdr->pmr", offset, bumps.factor) - bumps.residual
    return bumps.log_height - 0.5 * np.sum(gap**2, axis=-1)


def log_normal(
    offset: np.ndarray, start: np.ndarray, variance: np.ndarray, in_use: np.ndarray
) -> np.ndarray:
    """Log-density of a kind's coordinates at offsets, summed over those in use."""
    each = -0.5 * ((offset - start) ** 2 / variance + np.log(variance) + _LOG_2_PI)
    return np.sum(np.where(in_use, each, 0.0), axis=-1)
