"""Noise inferred with everything else, against sums over the joint normal density."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from scipy.optimize import minimize
from scipy.stats import multivariate_t

from boomdp_jax.inference.hypotheses.noise_level import (
    NoiseFit,
    log_noise_prior,
    prior_noise,
)
from boomdp_jax.inference.infer import infer
from boomdp_jax.inference.noise import correction as noise_correction
from tests.inference.joint_normal import joint_normal
from tests.inference.recordings import AREA, NOISE, box_scene, free_box

# Prior of the readings' noise and of a density, as `prior` in a scene file has them.
SCALE = np.array([1e-3, 1e-3, 4e-3, 4e-3])
MEDIAN, SPREAD = 30.0, 1.5


def test_prior_of_noise_is_normalised_and_is_what_is_drawn():
    rng = np.random.default_rng(0)
    reading, impulse = prior_noise(rng, SCALE, (20_000, 1))
    vector = NoiseFit(reading, impulse).vector
    # The mean of proposal over prior density is one, for draws of the prior.
    proposal = multivariate_t(vector.mean(0), np.diag(0.3 * vector.var(0)), df=20)
    ratio = np.exp(
        proposal.logpdf(vector) - log_noise_prior(np.tile(SCALE, (20_000, 1)), vector)
    )
    np.testing.assert_allclose(
        ratio.mean(), 1.0, atol=4.0 * ratio.std() / np.sqrt(20_000)
    )


@pytest.fixture(scope="module")
def reference():
    """Mean and sd of log-mass and six log-noises, and the log-evidence.

    By importance sampling from a t that is fitted a few times over.
    """
    history = free_box(np.random.default_rng(11), 30, noise=3.0 * NOISE)
    joint = joint_normal(history)
    middle = np.log(0.1 * SCALE[2:])

    def log_posterior(x):
        reading = x[1:5]
        prior = dist.Normal(np.log(MEDIAN * AREA), SPREAD).log_prob(x[0])
        variance = jnp.exp(2.0 * reading)
        gamma = dist.InverseGamma(1.0, jnp.asarray(SCALE**2)).log_prob(variance)
        prior = prior + jnp.sum(gamma + jnp.log(2.0 * variance))
        kicks = dist.Normal(jnp.asarray(middle), 2.0).log_prob(x[5:])
        return prior + jnp.sum(kicks) + joint.log_density(jnp.exp(x[0]), x[1:])

    start = jnp.asarray([np.log(3.0), *np.log(3.0 * SCALE), *middle])
    found = minimize(
        jax.jit(lambda x: -log_posterior(x)),
        start,
        jac=jax.jit(jax.grad(lambda x: -log_posterior(x))),
        method="BFGS",
    )
    curvature = np.asarray(jax.hessian(lambda x: -log_posterior(x))(found.x))
    length, way = np.linalg.eigh(curvature)
    mean, covariance = found.x, 2.0 * (way / np.maximum(length, 0.2)) @ way.T
    density = jax.jit(jax.vmap(log_posterior))
    for seed in range(5):
        proposal = multivariate_t(mean, covariance, df=6, seed=seed)
        points = proposal.rvs(8000)
        value = [density(jnp.asarray(part)) for part in np.split(points, 16)]
        log_weight = np.concatenate(value) - proposal.logpdf(points)
        log_weight = np.where(np.isfinite(log_weight), log_weight, -np.inf)
        weight = np.exp(log_weight - log_weight.max())
        mean = np.average(points, axis=0, weights=weight)
        covariance = 1.2 * np.cov(points.T, aweights=weight)
    assert weight.sum() ** 2 / np.sum(weight**2) > 1000
    evidence = np.logaddexp.reduce(log_weight) - np.log(len(weight))
    sd = np.sqrt(np.average((points - mean) ** 2, axis=0, weights=weight))
    return history, mean, sd, evidence


@pytest.mark.slow
@pytest.mark.parametrize("method", ["rj", "enumerate", "smc"])
def test_mass_noise_and_evidence_are_those_of_the_joint_density(reference, method):
    history, mean, sd, evidence = reference
    posterior = infer(jax.random.key(3), box_scene(), history, method=method)
    found = np.concatenate(
        [
            np.log(np.asarray(posterior.params.density) * AREA),
            np.log(np.asarray(posterior.noise_scale)[:, 0]),
            np.log(np.asarray(posterior.impulse_scale)[:, 0]),
        ],
        axis=1,
    )
    offset, ratio = (found.mean(0) - mean) / sd, found.std(0) / sd
    # Of thirty readings noise has a long tail, to which few draws go.
    assert abs(offset[0]) < 0.15
    assert abs(ratio[0] - 1.0) < 0.15
    np.testing.assert_array_less(np.abs(offset[1:]), 0.3)
    np.testing.assert_allclose(ratio[1:], 1.0, atol=0.35)
    error = posterior.diagnostics["log_evidence_error"]
    assert abs(float(posterior.log_evidence) - evidence) < 0.05 + 4.0 * error


@pytest.mark.slow
def test_progress_is_told_move_by_move_and_changes_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    # Draws are never worth enough, and few moves are made.
    for name, value in {"_ENOUGH": 1e9, "_ENOUGH_SHARE": 10, "_MOST_MOVES": 3}.items():
        monkeypatch.setattr(noise_correction, name, value)
    history = free_box(np.random.default_rng(0), 30)
    known = jax.random.key(3), box_scene(), history
    options = {"method": "smc", "num_chains": 2, "num_samples": 64, "num_warmup": 1}
    told = infer(*known, progress=True, **options)
    stages = capsys.readouterr().err
    assert re.search(r"inferring the noise, step 1, power 0\]", stages)
    assert re.search(r"inferring the noise, step \d+, power 1, move 1 of \d", stages)
    for number in (1, 2, 3):
        assert f"inferring the noise, move {number} of at most 3]" in stages
    silent = infer(*known, **options)
    assert not capsys.readouterr().err
    for one, other in zip(
        jax.tree.leaves(told.params), jax.tree.leaves(silent.params), strict=True
    ):
        assert np.asarray(one).tobytes() == np.asarray(other).tobytes()
    assert float(told.log_evidence) == float(silent.log_evidence)
