"""Laws are weighed at the noise that would be left with them."""

import numpy as np
import pytest

from boomdp_jax.inference.doubts.less_noise import (
    AtNoise,
    is_worth_asking,
    weighed_again,
)
from boomdp_jax.inference.doubts.residual_regression import LawFit

NUM = 60
NO_MOVES = np.zeros(1), np.ones(1, bool)
"""A coordinate that readings do not depend on, at its prior mean."""
FACTORS = np.array([1.0, 0.5, 0.2])


def levels_of(reading: np.ndarray, law: np.ndarray, noise: float) -> list[AtNoise]:
    """Of one channel that is read straight, by so much noise and by shares of it."""
    counts = np.zeros((NUM, 2, 1, 6))
    counts[:, 1, 0, 5] = 1.0

    def table(column: np.ndarray) -> np.ndarray:
        return counts * column[:, None, None, None]

    return [
        AtNoise(
            table(reading / sd),
            counts,
            -NUM * np.log(sd),
            np.zeros((1, *counts.shape)),
            table(law / sd)[None],
        )
        for sd in noise * FACTORS
    ]


def likelihood(rest: np.ndarray, noise: float) -> float:
    """Log-likelihood at the best level, or at more noise than is taken."""
    found = []
    for sd in noise * FACTORS:
        best = max(sd, float(np.sqrt(np.mean(rest**2))))
        found.append(-NUM * np.log(best) - 0.5 * np.sum(rest**2) / best**2)
    return max(found)


@pytest.mark.parametrize("share", [0.0, 2.0])
def test_evidence_is_the_ratio_of_likelihoods_each_at_its_best_noise(share):
    rng = np.random.default_rng(1)
    law = rng.normal(size=NUM)
    reading = rng.normal(size=NUM) + share * law
    noise = float(np.sqrt(np.mean(reading**2)))
    fit = LawFit(np.ones(1), np.ones(1), -10.0, steady=1e3)
    levels = levels_of(reading, law, noise)
    (found,) = weighed_again([fit], levels, *NO_MOVES)
    rest = reading - law * (law @ reading) / (law @ law)
    gain = likelihood(rest, noise) - likelihood(reading, noise) - np.log(len(FACTORS))
    expected = gain * NUM / (NUM + 1) - 0.5 * np.log(NUM + 1)
    np.testing.assert_allclose(found.log_bayes_factor, expected, rtol=1e-6)
    # By the noise that was found alone it comes to a square of the law's share of it.
    alone = 0.5 * (1.0 - np.sum(rest**2) / np.sum(reading**2)) * NUM
    assert (found.log_bayes_factor > alone) == (share > 0.0)


def test_stretches_that_do_not_agree_bound_it_and_nothing_lowers_it():
    rng = np.random.default_rng(2)
    law = rng.normal(size=NUM)
    levels = levels_of(rng.normal(size=NUM) + 3.0 * law, law, 3.0)
    fits = [
        LawFit(np.ones(1), np.ones(1), log_bayes_factor, steady)
        for log_bayes_factor, steady in ((1.0, 9.0), (500.0, 1e3))
    ]
    both = [
        level._replace(pushes=np.repeat(level.pushes, 2, axis=0)) for level in levels
    ]
    found = weighed_again(fits, both, *NO_MOVES)
    assert [fit.log_bayes_factor for fit in found] == [9.0, 500.0]


def test_only_laws_that_hold_all_along_are_asked_about():
    def fit(evidence: float, steady: float) -> LawFit:
        return LawFit(np.ones(1), np.ones(1), evidence, steady)

    assert is_worth_asking(fit(5.0, 20.0))
    assert not is_worth_asking(fit(5.0, 5.5))
    assert not is_worth_asking(fit(20.0, 20.0))
    assert not is_worth_asking(fit(-3.0, 2.0))
