"""Noise inferred with everything else, against NUTS on the joint normal density."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from numpyro.infer import MCMC, NUTS
from scipy.stats import multivariate_t

from boomdp_jax.inference.infer import infer
from boomdp_jax.inference.noise_level import NoiseFit, log_noise_prior, prior_noise
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
    """Draws of log-mass and six log-noises by NUTS, and the log-evidence."""
    history = free_box(np.random.default_rng(11), 15, noise=3.0 * NOISE)
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

    kernel = NUTS(potential_fn=lambda x: -log_posterior(x), dense_mass=True)
    mcmc = MCMC(
        kernel,
        num_warmup=300,
        num_samples=1000,
        num_chains=4,
        chain_method="vectorized",
        progress_bar=False,
    )
    start = jnp.asarray([np.log(3.0), *np.log(5.0 * SCALE), *middle])
    mcmc.run(jax.random.key(0), init_params=jnp.tile(start, (4, 1)))
    draws = np.asarray(mcmc.get_samples())
    proposal = multivariate_t(draws.mean(0), 1.3 * np.cov(draws.T), df=6, seed=1)
    points = proposal.rvs(20_000)
    weight = np.asarray(jax.lax.map(log_posterior, jnp.asarray(points), batch_size=500))
    weight = weight - proposal.logpdf(points)
    evidence = np.logaddexp.reduce(weight) - np.log(len(weight))
    return history, draws, evidence


@pytest.mark.slow
@pytest.mark.parametrize("method", ["rj", "enumerate", "smc"])
def test_mass_noise_and_evidence_are_those_of_the_joint_density(reference, method):
    history, draws, evidence = reference
    posterior = infer(jax.random.key(3), box_scene(), history, method=method)
    found = np.concatenate(
        [
            np.log(np.asarray(posterior.params.density) * AREA),
            np.log(np.asarray(posterior.noise_scale)[:, 0]),
            np.log(np.asarray(posterior.impulse_scale)[:, 0]),
        ],
        axis=1,
    )
    sd = draws.std(0)
    # Two thousand draws that count for a few hundred at least.
    np.testing.assert_array_less(np.abs(found.mean(0) - draws.mean(0)) / sd, 0.25)
    np.testing.assert_allclose(found.std(0), sd, rtol=0.2)
    error = posterior.diagnostics["log_evidence_error"]
    assert abs(float(posterior.log_evidence) - evidence) < 0.05 + 4.0 * error
