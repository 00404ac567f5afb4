"""Every sampler over structures against closed forms of a linear Gaussian model."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from boomdp_jax.inference.fits.fit import Modes
from boomdp_jax.inference.sample import SAMPLERS
from boomdp_jax.inference.samplers.structure_draws import SampleSettings
from tests.inference.linear_gaussian import (
    SLOT,
    STRUCTURES,
    closed_form,
    in_use,
    make_problem,
    two_sided,
)

FALSE_ALARM = 1e-4
SEEDS = (0, 1)
SETTINGS = SampleSettings(num_chains=4, num_warmup=64, num_samples=500)
# Jumps compile longest, and have slow tests of their own.
WITH_ERRORS = (pytest.param("rj", marks=pytest.mark.slow), "enumerate", "smc")


@jax.jit
def evaluate(targets, structure, z):
    return jax.vmap(lambda target, k, z: jax.vmap(target.log_density)(k, z), (0, 0, 0))(
        targets, structure, z
    )


@functools.cache
def problem():
    """Two objects, and what is true of them."""
    made = [make_problem(seed=seed) for seed in SEEDS]
    targets = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(m[0] for m in made))
    return targets, [closed_form(design, data) for _, design, data in made]


def modes_of(truths, *, shift: float = 0.0, tightness: float = 1.0) -> Modes:
    """Posterior modes, moved by so many standard deviations, and too tight by so much.

    The density there is what the target has at the true mode, as a poor fit would not
    know; only the mixture's first weights depend on it.
    """
    num = len(STRUCTURES)
    z = np.zeros((len(SEEDS), num, SLOT.size))
    precision = np.tile(np.eye(SLOT.size), (len(SEEDS), num, 1, 1))
    for i, (_, _, means, covariances) in enumerate(truths):
        for k in range(num):
            used = in_use(k)
            z[i, k, used] = means[k] + shift * np.sqrt(np.diag(covariances[k]))
            block = np.ix_(used, used)
            precision[i, k][block] = tightness**2 * np.linalg.inv(covariances[k])
    structure = jnp.tile(jnp.arange(num, dtype=jnp.int32), (len(SEEDS), 1))
    targets, _ = problem()
    log_density = evaluate(targets, structure, jnp.asarray(z))
    return Modes(structure, jnp.asarray(z), jnp.asarray(precision), log_density)


@functools.cache
def drawn(method: str, key: int = 3, shift: float = 0.7, tightness: float = 0.8):
    targets, truths = problem()
    modes = modes_of(truths, shift=shift, tightness=tightness)
    return SAMPLERS[method](jax.random.key(key), targets, modes, SETTINGS, evaluate)


@pytest.mark.parametrize("method", WITH_ERRORS)
@pytest.mark.slow
def test_evidence_agrees_with_the_closed_form(method):
    _, truths = problem()
    evidence = drawn(method).evidence
    scores = []
    for i, (log_evidence, probability, _, _) in enumerate(truths):
        seen = np.isfinite(evidence.log_evidence[i])
        scores.append((evidence.log_evidence[i] - log_evidence)[seen])
        scores[-1] /= evidence.error[i][seen]
        gap = evidence.probability[i] - probability
        scores.append(gap[seen] / evidence.probability_error[i][seen])
        # What a method has not seen must be rare.
        assert np.all(probability[~seen] < 0.01)
    scores = np.concatenate(scores)
    # Errors by sixteen replicates follow a t distribution.
    limit = stats.t.isf(FALSE_ALARM / (2 * scores.size), 15)
    assert np.max(np.abs(scores)) < limit
    assert np.all(evidence.total_error < 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("method", WITH_ERRORS)
def test_draws_follow_the_posterior(method):
    _, truths = problem()
    found = drawn(method)
    assert found.structure.shape == found.log_density.shape
    for i, (_, probability, means, covariances) in enumerate(truths):
        structure = found.structure[i].ravel()
        z = found.z[i].reshape(structure.size, -1)
        shares = np.bincount(structure, minlength=len(probability)) / structure.size
        # As if a quarter of the draws were independent.
        error = np.sqrt(probability * (1 - probability) / (structure.size / 4))
        assert np.all(np.abs(shares - probability) < 4.5 * error + 1e-3)
        k = int(np.argmax(probability))
        mine = z[structure == k][:, in_use(k)]
        size = len(mine) / 4
        offset = (mine.mean(0) - means[k]) / np.sqrt(np.diag(covariances[k]) / size)
        assert np.max(np.abs(offset)) < two_sided(FALSE_ALARM, offset.size)
        ratio = mine.var(axis=0, ddof=1) / np.diag(covariances[k])
        assert np.max(np.abs(ratio - 1)) < 4.5 * np.sqrt(2 / size)
        assert np.all(z[structure == k][:, ~in_use(k)] == 0)


@pytest.mark.slow
@pytest.mark.parametrize("method", WITH_ERRORS)
def test_good_modes_give_a_good_verdict(method):
    for verdict in drawn(method).diagnostics:
        assert verdict.ok, verdict.reasons


@pytest.mark.slow
@pytest.mark.parametrize("method", WITH_ERRORS)
def test_stated_errors_are_honest(method):
    """Scores of twenty runs have a spread of one, within what chance allows."""
    _, truths = problem()
    scores = []
    for key in range(20):
        evidence = drawn(method, key=100 + key).evidence
        for i, (log_evidence, _, _, _) in enumerate(truths):
            prior = np.asarray(problem()[0].log_prior[i])
            total = np.logaddexp.reduce(log_evidence + prior)
            scores.append((evidence.total[i] - total) / evidence.total_error[i])
    square = np.sum(np.square(scores))
    # Too small an error is a lie; one half too large is only a waste.
    assert square < stats.chi2.isf(FALSE_ALARM, len(scores)) * 1.3
    assert square > stats.chi2.ppf(FALSE_ALARM, len(scores)) * 0.2


@pytest.mark.parametrize("method", ["enumerate", "smc"])
def test_modes_far_off_are_recovered_from_or_reported(method):
    _, truths = problem()
    found = drawn(method, shift=3.0, tightness=3.0)
    for i, (log_evidence, probability, _, _) in enumerate(truths):
        prior = np.asarray(problem()[0].log_prior[i])
        total = np.logaddexp.reduce(log_evidence + prior)
        is_right = abs(found.evidence.total[i] - total) < 0.3
        is_right &= np.all(np.abs(found.evidence.probability[i] - probability) < 0.1)
        assert is_right or not found.diagnostics[i].ok


def test_laplace_is_exact_on_gaussian_posteriors():
    _, truths = problem()
    found = drawn("laplace", shift=0.0, tightness=1.0)
    for i, (log_evidence, probability, _, _) in enumerate(truths):
        np.testing.assert_allclose(
            found.evidence.log_evidence[i], log_evidence, rtol=1e-9
        )
        np.testing.assert_allclose(found.evidence.probability[i], probability)
        assert found.diagnostics[i].ok
        assert np.all(np.isnan(found.evidence.error[i]))


def test_laplace_says_where_it_is_wrong():
    found = drawn("laplace", shift=1.5, tightness=1.5)
    for verdict in found.diagnostics:
        assert not verdict.ok
        assert "normal approximation" in " ".join(verdict.reasons)


def test_map_is_the_best_mode_of_the_best_structure():
    _, truths = problem()
    found = drawn("map", shift=0.0, tightness=1.0)
    assert found.structure.shape == (len(SEEDS), 1, 1)
    for i, (_, probability, means, _) in enumerate(truths):
        k = int(np.argmax(probability))
        assert found.structure[i, 0, 0] == k
        np.testing.assert_allclose(found.z[i, 0, 0, in_use(k)], means[k])
