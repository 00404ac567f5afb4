"""The sampler and the evidence against closed forms of a linear Gaussian model."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro.diagnostics import effective_sample_size
from scipy import stats

from boomdp_jax.inference.samplers.importance_evidence import importance_evidence
from boomdp_jax.inference.samplers.mixture_building import (
    add_prior_components,
    laplace_mixture,
    refine_weights,
)
from boomdp_jax.inference.samplers.structure_chain import ChainSettings, run_chains
from tests.inference.linear_gaussian import (
    PRIOR,
    closed_form,
    in_use,
    make_problem,
    skewed_mixture,
    two_sided,
)

FALSE_ALARM = 1e-4


def scores_of_chains(draws, probability, means, covariances) -> np.ndarray:
    """How many standard errors probabilities and moments are off."""
    structure, z = np.asarray(draws.structure), np.asarray(draws.z)
    scores = []

    def add(values, expected, sd):
        size = effective_sample_size(values.astype(float))
        scores.append((values.mean() - expected) / (sd / np.sqrt(size)))

    for index, expected in enumerate(probability):
        is_here = structure == index
        add(is_here, expected, np.sqrt(expected * (1 - expected)))
        for row, coordinate in enumerate(np.flatnonzero(in_use(index))):
            mean, variance = means[index][row], covariances[index][row, row]
            deviation = np.where(is_here, z[..., coordinate] - mean, 0.0)
            add(deviation, 0.0, np.sqrt(expected * variance))
            squares = np.where(is_here, deviation**2 - variance, 0.0)
            add(squares, 0.0, np.sqrt(2.0 * expected) * variance)
    return np.array(scores)


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        ChainSettings(),
        ChainSettings(num_jumps=0, num_walks=2),
        ChainSettings(num_jumps=0, num_walks=0, num_leapfrog=3),
    ],
    ids=["all moves", "local moves", "local moves with gradients"],
)
def test_chains_agree_with_closed_form(settings):
    target, design, data = make_problem()
    _, probability, means, covariances = closed_form(design, data)
    mixture = skewed_mixture(target, means, covariances)
    draws, info = run_chains(
        jax.random.key(1),
        target,
        mixture,
        num_chains=8,
        num_warmup=100,
        num_samples=2500,
        settings=settings,
    )
    scores = scores_of_chains(draws, probability, means, covariances)
    assert np.max(np.abs(scores)) < two_sided(FALSE_ALARM, scores.size)
    assert np.sum(info.accepted[..., 1]) > 500


@pytest.mark.slow
def test_chains_agree_with_closed_form_in_either_precision(precision):
    target, design, data = make_problem(seed=3)
    _, probability, means, covariances = closed_form(design, data)
    mixture = skewed_mixture(target, means, covariances)
    draws, _ = run_chains(
        jax.random.key(5),
        target,
        mixture,
        num_chains=4,
        num_warmup=50,
        num_samples=1500,
    )
    assert draws.z.dtype == precision.choose(single=jnp.float32, double=jnp.float64)
    scores = scores_of_chains(draws, probability, means, covariances)
    assert np.max(np.abs(scores)) < two_sided(FALSE_ALARM, scores.size)


def test_importance_evidence_agrees_with_closed_form(precision):
    target, design, data = make_problem(seed=1)
    log_evidence, probability, means, covariances = closed_form(design, data)
    mixture = skewed_mixture(target, means, covariances)
    found = importance_evidence(
        jax.random.key(2), target, mixture, 6000, chunk_size=500
    )
    scores = np.concatenate(
        [
            (found.log_evidence - log_evidence) / found.evidence_error,
            (found.probability - probability) / found.probability_error,
        ]
    )
    assert np.max(np.abs(scores)) < two_sided(FALSE_ALARM, scores.size)
    assert found.effective_sample_size > 1500
    rounding = precision.choose(single=1e-4, double=1e-9)
    np.testing.assert_allclose(np.sum(found.probability), 1.0, atol=rounding)


@pytest.mark.slow
def test_stated_errors_of_evidence_are_honest():
    target, design, data = make_problem(seed=1)
    log_evidence, _, means, covariances = closed_form(design, data)
    mixture = skewed_mixture(target, means, covariances)
    keys = jax.random.split(jax.random.key(0), 60)
    found = jax.vmap(lambda key: importance_evidence(key, target, mixture, 600))(keys)
    scores = (np.asarray(found.log_evidence) - log_evidence) / found.evidence_error
    mean_square = np.mean(np.asarray(scores) ** 2, axis=0)
    # Systematic draws can only be better than the errors say, though not by much.
    limit = stats.chi2.isf(FALSE_ALARM / len(PRIOR), len(keys)) / len(keys)
    assert np.all(mean_square < limit)
    assert np.all(mean_square > 0.1)


def test_laplace_mixture_is_exact_for_a_gaussian(precision):
    target, design, data = make_problem(seed=2)
    _, probability, means, covariances = closed_form(design, data)
    structure = jnp.arange(len(PRIOR))
    modes = np.zeros((len(PRIOR), design.shape[1]))
    for index in range(len(PRIOR)):
        modes[index, in_use(index)] = means[index]
    modes = jnp.asarray(modes, float)

    @jax.jit
    def build(structure, modes):
        hessian = jax.vmap(
            lambda k, z: -jax.hessian(lambda z: target.log_density(k, z))(z)
        )(structure, modes)
        log_density = jax.vmap(target.log_density)(structure, modes)
        return laplace_mixture(target, structure, modes, hessian, log_density)

    mixture = build(structure, modes)
    tolerance = precision.choose(single=2e-5, double=1e-12)
    np.testing.assert_allclose(np.exp(mixture.log_weight), probability, atol=tolerance)
    for index in range(len(PRIOR)):
        used = np.ix_(in_use(index), in_use(index))
        factor = np.asarray(mixture.scale_tril[index])[used]
        np.testing.assert_allclose(
            factor @ factor.T, covariances[index], atol=tolerance
        )


@pytest.mark.slow
def test_refined_weights_are_structure_probabilities():
    target, design, data = make_problem(seed=1)
    _, probability, means, covariances = closed_form(design, data)
    mixture = eqx.filter_jit(add_prior_components)(
        target, skewed_mixture(target, means, covariances), total_weight=0.1
    )
    found = importance_evidence(jax.random.key(2), target, mixture, 4000)
    refined = eqx.filter_jit(refine_weights)(
        target, mixture, found.structure, found.z, found.log_weight, floor=0.06
    )
    expected = 0.94 * probability + 0.01
    weight = np.exp(refined.structure_log_weight(target))
    scores = (weight - expected) / (0.94 * found.probability_error)
    assert np.max(np.abs(scores)) < two_sided(FALSE_ALARM, scores.size)


@pytest.mark.slow
def test_objects_can_be_batched_and_compile_once():
    traces = []

    class Counting(eqx.Module):
        inner: eqx.Module

        def __call__(self, z, active):
            traces.append(1)
            return self.inner(z, active)

    problems = [make_problem(seed) for seed in range(3)]
    built = []
    for target, design, data in problems:
        _, _, means, covariances = closed_form(design, data)
        target = eqx.tree_at(
            lambda t: t.log_likelihood, target, Counting(target.log_likelihood)
        )
        built.append((target, skewed_mixture(target, means, covariances)))
    targets, mixtures = jax.tree.map(lambda *leaves: jnp.stack(leaves), *built)
    keys = jax.random.split(jax.random.key(0), 3)

    def run(key, target, mixture):
        return run_chains(
            key, target, mixture, num_chains=2, num_warmup=10, num_samples=40
        )

    draws, _ = eqx.filter_vmap(run)(keys, targets, mixtures)
    for index, (target, mixture) in enumerate(built):
        alone, _ = run(keys[index], target, mixture)
        np.testing.assert_array_equal(alone.structure, draws.structure[index])
        np.testing.assert_allclose(alone.z, draws.z[index], atol=1e-9)
        if index == 0:
            num_traces = len(traces)
    assert len(traces) == num_traces
