"""A target with a closed form: y = X z + e, a structure says which z are in use."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy import stats

from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture, make_mixture

SLOT = np.array([-1, 0, 1, 1, 2])
# Not every combination exists, so structures differ in how many neighbours they have.
STRUCTURES = np.array(
    [
        [False, False, False],
        [True, False, False],
        [False, True, False],
        [False, False, True],
        [True, True, False],
        [True, False, True],
    ]
)
PRIOR = np.array([0.3, 0.2, 0.15, 0.15, 0.12, 0.08])


class LinearLikelihood(eqx.Module):
    """Gaussian likelihood of a linear model; data are leaves, so they batch."""

    design: Array
    data: Array
    noise_scale: Array

    def __call__(self, z: Array, active: Array) -> Array:
        residual = (self.data - self.design @ z) / self.noise_scale
        num_rows = self.data.shape[-1]
        return -0.5 * jnp.sum(residual**2) - num_rows * (
            jnp.log(self.noise_scale) + 0.5 * jnp.log(2.0 * jnp.pi)
        )


class NoLikelihood(eqx.Module):
    """A likelihood that says nothing."""

    def __call__(self, z: Array, active: Array) -> Array:
        return jnp.zeros(())


def make_target(likelihood, period: np.ndarray | None = None) -> StructureTarget:
    """The six structures above with a likelihood of one's choice."""
    period = np.zeros(SLOT.size) if period is None else period
    return StructureTarget(
        log_likelihood=likelihood,
        structures=jnp.asarray(STRUCTURES),
        log_prior=jnp.asarray(np.log(PRIOR), float),
        slot=jnp.asarray(SLOT, jnp.int32),
        period=jnp.asarray(period, float),
    )


def make_problem(
    seed: int = 0, noise_scale: float = 0.7, num_rows: int = 8
) -> tuple[StructureTarget, np.ndarray, np.ndarray]:
    """A linear target with its design and data."""
    rng = np.random.default_rng(seed)
    design = 0.6 * rng.normal(size=(num_rows, SLOT.size))
    truth = np.array([0.5, 0.9, 0.0, 0.0, 0.0])
    data = design @ truth + noise_scale * rng.normal(size=num_rows)
    likelihood = LinearLikelihood(
        jnp.asarray(design, float),
        jnp.asarray(data, float),
        jnp.asarray(noise_scale, float),
    )
    return make_target(likelihood), design, data


def in_use(structure: int) -> np.ndarray:
    """Coordinates of a structure, by NumPy."""
    return (SLOT < 0) | STRUCTURES[structure][np.maximum(SLOT, 0)]


def closed_form(
    design: np.ndarray, data: np.ndarray, noise_scale: float = 0.7
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """Log-evidence, probability, posterior means and covariances of the structures."""
    log_evidence, means, covariances = [], [], []
    for index in range(len(STRUCTURES)):
        X = design[:, in_use(index)]
        marginal = noise_scale**2 * np.eye(len(data)) + X @ X.T
        log_evidence.append(
            stats.multivariate_normal(np.zeros(len(data)), marginal).logpdf(data)
        )
        covariance = np.linalg.inv(np.eye(X.shape[1]) + X.T @ X / noise_scale**2)
        covariances.append(covariance)
        means.append(covariance @ X.T @ data / noise_scale**2)
    joint = np.array(log_evidence) + np.log(PRIOR)
    probability = np.exp(joint - np.logaddexp.reduce(joint))
    return np.array(log_evidence), probability, means, covariances


def skewed_mixture(
    target: StructureTarget,
    means: list[np.ndarray],
    covariances: list[np.ndarray],
    *,
    shift: float = 0.3,
    widening: float = 1.3,
) -> LaplaceMixture:
    """Two components a structure, off centre, with the wrong widths and weights."""
    structure, mean, scale, weight = [], [], [], []
    for index in range(len(STRUCTURES)):
        used = np.flatnonzero(in_use(index))
        for side in (-1.0, 1.0):
            sd = np.sqrt(np.diag(covariances[index]))
            centre, factor = np.zeros(SLOT.size), np.eye(SLOT.size)
            centre[used] = means[index] + side * shift * sd
            factor[np.ix_(used, used)] = widening * np.linalg.cholesky(
                covariances[index]
            )
            structure.append(index)
            mean.append(centre)
            scale.append(factor)
            weight.append(0.3 * index + 0.2 * side)
    return make_mixture(
        target,
        jnp.asarray(structure, jnp.int32),
        jnp.asarray(np.array(mean), float),
        jnp.asarray(np.array(scale), float),
        jnp.asarray(weight, float),
    )


def sample_exactly(
    seed: int,
    num_draws: int,
    probability: np.ndarray,
    means: list[np.ndarray],
    covariances: list[np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Independent draws of structure and coordinates from the closed form."""
    rng = np.random.default_rng(seed)
    structure = rng.choice(len(probability), size=num_draws, p=probability)
    z = np.zeros((num_draws, SLOT.size))
    for index in range(len(probability)):
        rows = np.flatnonzero(structure == index)
        z[np.ix_(rows, np.flatnonzero(in_use(index)))] = rng.multivariate_normal(
            means[index], covariances[index], size=rows.size
        )
    return structure.astype(np.int32), z


def two_sided(false_alarm: float, num_tests: int) -> float:
    """Largest |z-score| allowed in any of several tests, Bonferroni."""
    return float(stats.norm.isf(0.5 * false_alarm / num_tests))
