"""What `infer` finds out from collisions that nobody pushed."""

import jax
import numpy as np
import pytest

import boomdp_jax
from tests.inference.two_discs import (
    RADIUS,
    approaching,
    discs_spec,
    record,
)

NUM_INFERRED = 4


@pytest.fixture(scope="module")
def inferred():
    """Several collisions in one compiled call, as users run it."""
    truths, histories = [], []
    for number in range(NUM_INFERRED):
        rng = np.random.default_rng([5, number])
        masses = np.exp(0.5 * rng.standard_normal(2))
        numbers = (*masses, rng.uniform(0.2, 0.9), rng.uniform(0.05, 0.4))
        start = approaching(rng, rng.uniform(0.2, 0.3))
        truths.append(numbers)
        histories.append(record(rng, start, numbers, 26))
    specs = [discs_spec()] * NUM_INFERRED
    with jax.enable_x64(False):
        posteriors = boomdp_jax.infer_batch(jax.random.key(0), specs, histories)
    return truths, posteriors


@pytest.mark.slow
def test_mass_ratio_and_restitution_are_found(inferred):
    for truth, posterior in zip(*inferred, strict=True):
        density = np.asarray(posterior.params.density, float)
        ratio = np.log(density[:, 0] / density[:, 1]) + 2 * np.log(
            RADIUS[0] / RADIUS[1]
        )
        bounce = np.asarray(posterior.params.surface.restitution, float)[:, 0]
        expected = np.log(truth[0] / truth[1]), truth[2]
        for draws, value in zip((ratio, bounce), expected, strict=True):
            # Eight comparisons at four sds: false alarm once in two thousand.
            assert abs(draws.mean() - value) < 4.0 * draws.std()
            assert draws.std() < 0.1


@pytest.mark.slow
def test_the_common_factor_of_the_masses_keeps_its_prior(inferred):
    for _, posterior in zip(*inferred, strict=True):
        density = np.log(np.asarray(posterior.params.density, float))
        # Given the ratio, half the variance of each logarithm is left.
        assert density.mean(axis=1).std() == pytest.approx(1.06, rel=0.25)


@pytest.mark.slow
def test_diagnostics_are_in_order(inferred):
    for posterior in inferred[1]:
        assert posterior.diagnostics["ok"], posterior.diagnostics["reasons"]


@pytest.mark.slow
def test_without_a_collision_contact_keeps_its_prior():
    """Two discs that pass each other at a distance."""
    start = np.zeros((2, 6))
    start[0, 3], start[1, :2] = 0.5, (0.3, 0.5)
    rng = np.random.default_rng(8)
    spec = discs_spec()
    history = record(rng, start, (1.0, 1.0, 0.5, 0.3), 16)
    with jax.enable_x64(False):
        posterior = boomdp_jax.infer(jax.random.key(1), spec, history)
    report = posterior.to_json()["contact"]
    for name in ("friction", "restitution"):
        assert not report[name]["identified"]
    restitution = np.asarray(posterior.params.surface.restitution)[:, 0]
    logit = np.log(restitution) - np.log1p(-restitution)
    # Independent draws: five standard errors of the mean and of the sd.
    assert logit.mean() == pytest.approx(0.0, abs=5 * 1.5 / np.sqrt(len(logit)))
    assert logit.std() == pytest.approx(1.5, rel=5 / np.sqrt(2 * len(logit)))
