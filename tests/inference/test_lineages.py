"""What draws of few lineages are worth, against draws whose worth is known."""

import numpy as np
import pytest

from boomdp_jax.inference.lineages import worth_of_draws

NUM = 2048


def family(rng, num_lineages: int, likeness: float, num_numbers: int = 1):
    """Unit normal draws, of which two of a lineage correlate by `likeness`."""
    root = np.arange(NUM) % num_lineages
    shared = rng.normal(size=(num_lineages, num_numbers))[root]
    own = rng.normal(size=(NUM, num_numbers))
    return np.sqrt(likeness) * shared + np.sqrt(1.0 - likeness) * own, root


@pytest.mark.parametrize("likeness", [0.0, 0.05, 0.5, 1.0])
def test_worth_is_that_of_equally_alike_draws(likeness):
    rng = np.random.default_rng(3)
    num_lineages, found = 32, []
    for _ in range(200):
        values, root = family(rng, num_lineages, likeness)
        offset = values - values.mean(axis=0)
        found.append(worth_of_draws(offset, root, np.zeros(NUM, int)))
    # The mean of draws has the variance 1/N + likeness (1/L - 1/N).
    expected = NUM / (1.0 + likeness * (NUM / num_lineages - 1.0))
    np.testing.assert_allclose(np.median(found), expected, rtol=0.15)


def test_the_worst_number_counts():
    rng = np.random.default_rng(4)
    good, root = family(rng, 256, 0.0, num_numbers=5)
    bad, _ = family(rng, 256, 1.0)
    group = np.zeros(NUM, int)
    alone = worth_of_draws(bad - bad.mean(), root, group)
    both = np.concatenate([good, bad], axis=1)
    worst = worth_of_draws(both - both.mean(axis=0), root, group)
    assert worst == pytest.approx(alone)
    assert alone < 400 < worth_of_draws(good - good.mean(axis=0), root, group)
    # A number that is the same for all says nothing.
    still = np.concatenate([good, np.zeros((NUM, 1))], axis=1)
    assert worth_of_draws(still - still.mean(axis=0), root, group) > 400


def test_groups_are_asked_one_by_one_and_small_ones_not_at_all():
    rng = np.random.default_rng(5)
    values, root = family(rng, 256, 0.0)
    group = np.where(np.arange(NUM) < 1000, 0, 1)
    assert worth_of_draws(values, root, group) > 400
    # One lineage alone in a group of half of the draws, and in one of a fortieth.
    assert worth_of_draws(values, np.where(group == 0, 0, root), group) == 1.0
    few = np.where(np.arange(NUM) < NUM // 40, 0, 1)
    assert worth_of_draws(values, np.where(few == 0, 0, root), few) > 400
