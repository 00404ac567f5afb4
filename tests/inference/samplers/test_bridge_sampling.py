"""Bridges between normal distributions, whose ratio of constants is known."""

import numpy as np
import pytest
from scipy import stats

from boomdp_jax.inference.samplers.bridge_sampling import bridge_evidence

LOG_Z = 7.5


def ratios(rng, num, offset, width):
    """Log p / q at draws from q, standard normal, and from p, normal times exp(7.5)."""
    target = stats.norm(offset, width)
    x, y = rng.normal(size=num), target.rvs(num, random_state=rng)
    return tuple(LOG_Z + target.logpdf(at) - stats.norm.logpdf(at) for at in (x, y))


@pytest.mark.parametrize(("offset", "width"), [(0.0, 1.0), (1.0, 0.7), (0.5, 2.0)])
def test_errors_are_honest(offset, width):
    rng = np.random.default_rng(2)
    found = [bridge_evidence(*ratios(rng, 400, offset, width)) for _ in range(200)]
    value, error = np.array(found).T
    if width == 1.0 and offset == 0.0:
        np.testing.assert_allclose(value, LOG_Z, atol=1e-9)
        return
    scores = (value - LOG_Z) / error
    # Mean square of 200 scores of unit variance: one in 10,000 a side.
    low, high = stats.chi2.ppf([1e-4, 1 - 1e-4], 200) / 200
    assert low < np.mean(scores**2) < high


def test_it_does_better_than_importance_sampling_with_light_tails():
    rng = np.random.default_rng(3)
    errors = []
    for _ in range(100):
        first, second = ratios(rng, 400, 0.5, 2.0)
        direct = np.logaddexp.reduce(first) - np.log(first.size)
        bridge = bridge_evidence(first, second).log_evidence
        errors.append([direct - LOG_Z, bridge - LOG_Z])
    by_importance, by_bridge = np.sqrt(np.mean(np.square(errors), axis=0))
    assert by_bridge < 0.6 * by_importance


def test_draws_outside_count_as_zero():
    rng = np.random.default_rng(4)
    # Half of the proposal's draws fall where p is zero: Z is half of what is left.
    first = np.where(rng.random(4000) < 0.5, 0.0, -np.inf)
    found = bridge_evidence(first, np.zeros(4000))
    assert abs(found.log_evidence - np.log(0.5)) < 4.5 * found.error
    assert found.error < 0.1


@pytest.mark.parametrize("empty", ["proposal", "posterior"])
def test_without_draws_there_is_no_evidence(empty):
    some, none = np.zeros(10), np.full(10, -np.inf)
    pair = (none, some) if empty == "proposal" else (some, none)
    found = bridge_evidence(*pair)
    assert found.log_evidence == -np.inf
    assert found.error == np.inf


def test_fewer_effective_draws_widen_the_error():
    rng = np.random.default_rng(5)
    first, second = ratios(rng, 400, 0.5, 2.0)
    whole = bridge_evidence(first, second)
    part = bridge_evidence(first, second, posterior_size=20.0)
    assert part.error > 1.5 * whole.error
