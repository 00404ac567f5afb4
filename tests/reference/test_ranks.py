"""Ranks of equals are uniform, ranks of others are not."""

import numpy as np
from scipy import stats

from tests.reference.ranks import NUM_DRAWS, rank, thin, uniformity


def ranks_among_normals(shift: float, scale: float) -> np.ndarray:
    rng = np.random.default_rng(5)
    return np.array(
        [
            rank(rng, shift + scale * rng.standard_normal(), rng.normal(size=NUM_DRAWS))
            for _ in range(400)
        ]
    )


def test_ranks_among_equals_are_uniform():
    # One false alarm in a thousand.
    assert uniformity(ranks_among_normals(0.0, 1.0)) > 1e-3


def test_a_shift_or_another_spread_shows():
    assert uniformity(ranks_among_normals(1.0, 1.0)) < 1e-6
    assert uniformity(ranks_among_normals(0.0, 2.0)) < 1e-6


def test_ties_are_broken_evenly():
    rng = np.random.default_rng(6)
    draws = np.repeat([0.0, 1.0], [20, NUM_DRAWS - 20])
    found = np.array([rank(rng, 0.0, draws) for _ in range(2100)])
    # The truth may come before, between or after its twenty equals.
    assert set(found) == set(range(21))
    assert stats.chisquare(np.bincount(found)).pvalue > 1e-3


def test_thinned_draws_are_distinct():
    places = thin(np.random.default_rng(7), 100)
    assert len(set(places)) == NUM_DRAWS
    assert places.max() < 100
