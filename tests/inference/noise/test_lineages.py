"""What draws of few lineages are worth, against draws whose worth is known."""

import numpy as np
import pytest

from boomdp_jax.inference.noise.lineages import worth_of_draws

NUM = 2048


def family(rng, root: np.ndarray, likeness: float, num_numbers: int = 1):
    """Unit normal draws, of which two of a lineage correlate by `likeness`."""
    shared = rng.normal(size=(root.max() + 1, num_numbers))[root]
    own = rng.normal(size=(len(root), num_numbers))
    return np.sqrt(likeness) * shared + np.sqrt(1.0 - likeness) * own


def worth(values: np.ndarray, root: np.ndarray, group: np.ndarray | None = None):
    group = np.zeros(len(root), int) if group is None else group
    offset = np.empty_like(values)
    for name in np.unique(group):
        offset[group == name] = values[group == name] - values[group == name].mean(0)
    return worth_of_draws(values, offset, root, group)


@pytest.mark.parametrize("likeness", [0.0, 0.05, 0.5, 1.0])
def test_worth_is_that_of_equally_alike_draws(likeness):
    rng = np.random.default_rng(3)
    num_lineages = 32
    root = np.arange(NUM) % num_lineages
    found = [worth(family(rng, root, likeness), root) for _ in range(200)]
    # The mean of draws has the variance 1/N + likeness (1/L - 1/N).
    expected = NUM / (1.0 + likeness * (NUM / num_lineages - 1.0))
    np.testing.assert_allclose(np.median(found), expected, rtol=0.15)


@pytest.mark.parametrize("likeness", [0.02, 0.1, 0.3, 1.0])
@pytest.mark.parametrize("sizes", [[1950] + [1] * 98, [1500] + [10] * 54 + [8]])
def test_draws_of_which_most_are_of_one_lineage_are_not_worth_more(sizes, likeness):
    rng = np.random.default_rng(8)
    root = np.repeat(np.arange(len(sizes)), sizes)
    # By one number alone, of one large lineage, hardly anything can be told.
    found = [worth(family(rng, root, likeness, 10), root) for _ in range(100)]
    square = np.sum(np.square(sizes)) / NUM
    expected = NUM / (1.0 + likeness * (square - 1.0))
    assert np.median(found) < 1.5 * expected


def test_the_worst_number_counts():
    rng = np.random.default_rng(4)
    root = np.arange(NUM) % 256
    good, bad = family(rng, root, 0.0, num_numbers=5), family(rng, root, 1.0)
    alone = worth(bad, root)
    both = np.concatenate([good, bad], axis=1)
    assert worth(both, root) == pytest.approx(alone)
    assert alone < 400 < worth(good, root)
    # A number that is the same for all but for rounding says nothing.
    still = np.full((NUM, 1), 0.1) * (1.0 + 1e-16 * np.arange(NUM)[:, None])
    assert worth(np.concatenate([good, still], axis=1), root) > 400


def test_groups_are_asked_one_by_one_and_small_ones_not_at_all():
    rng = np.random.default_rng(5)
    root = np.arange(NUM) % 256
    values = family(rng, root, 0.0)
    group = np.where(np.arange(NUM) < 1000, 0, 1)
    assert worth(values, root, group) > 400
    # One lineage alone in a group of half of the draws, and in one of a fortieth.
    assert worth(values, np.where(group == 0, 0, root), group) == 1.0
    few = np.where(np.arange(NUM) < NUM // 40, 0, 1)
    assert worth(values, np.where(few == 0, 0, root), few) > 400


@pytest.mark.parametrize("num", [1, 2, 20, 300])
def test_draws_without_copies_are_worth_what_they_are(num):
    values = np.random.default_rng(6).normal(size=(num, 3))
    assert worth(values, np.arange(num)) == num
