"""Proposals of noise against SciPy's t, and chunks of points against a plain loop."""

import numpy as np
import pytest
from scipy.stats import kstest, multivariate_t

from boomdp_jax.inference.chunking import Chunking
from boomdp_jax.inference.noise_proposal import NoiseProposal


@pytest.fixture(scope="module")
def proposal():
    rng = np.random.default_rng(0)
    factors = np.tril(rng.normal(size=(2, 3, 3))) + 3.0 * np.eye(3)
    return NoiseProposal(rng.normal(size=(2, 3)), factors)


def reference(proposal: NoiseProposal, group: int):
    lower = proposal.lower[group]
    return multivariate_t(
        proposal.center[group], np.linalg.inv(lower @ lower.T), df=5.0
    )


def test_density_is_that_of_a_t(proposal):
    points = np.random.default_rng(1).normal(size=(20, 3))
    for group in range(2):
        found = proposal.log_density(points, np.full(20, group))
        expected = reference(proposal, group).logpdf(points)
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_draws_follow_their_group(proposal):
    rng = np.random.default_rng(2)
    group = np.repeat([0, 1], 4000)
    draws = proposal.sample(rng, group)
    for which in range(2):
        theirs = reference(proposal, which).rvs(4000, random_state=3)
        own = draws[group == which]
        for direction in np.eye(3):
            assert kstest(own @ direction, theirs @ direction).pvalue > 1e-4


@pytest.mark.parametrize("num_points", [0, 1, 31, 500])
def test_every_point_gets_its_own_result(num_points):
    rng = np.random.default_rng(num_points)
    index = rng.integers(0, 3, num_points)
    structure = rng.integers(0, 4, num_points)
    value = rng.normal(size=num_points)
    chunks = Chunking.of(index, structure, 4)
    found = []
    for (objects, structures), rows in chunks.calls():
        if num_points:
            assert np.all(index[rows] == objects[:, None])
            assert np.all(structure[rows] == structures[:, None])
            found.append(value[rows])
    if num_points:
        np.testing.assert_array_equal(chunks.in_order(found), value)
    else:
        assert not found
