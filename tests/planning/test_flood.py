"""Floods of bits against labels of the same maps."""

import numpy as np
import pytest
from scipy import ndimage

from boomdp_jax.planning.flood import packed, reached


def unpacked(words, num):
    bits = words[..., None] >> np.arange(num, dtype=np.uint64)
    return (bits & np.uint64(1)).astype(bool)


def labelled(free, seed):
    """Cells in a region that holds a free seed."""
    labels, _ = ndimage.label(free)
    return np.isin(labels, np.unique(labels[seed & free])) & free


@pytest.mark.parametrize("shape", [(1, 64), (30, 64), (70, 17), (64, 63), (40, 1)])
def test_flood_fills_the_regions_that_hold_a_seed(shape):
    random = np.random.default_rng(0)
    share = random.uniform(0.4, 0.95, (40, 1, 1))
    free = random.random((40, *shape)) < share
    # Some of the seeds are where nobody can be.
    seeds = random.random((40, *shape)) < 2.0 / np.prod(shape)
    found = reached(packed(free), packed(seeds))
    wanted = np.stack([labelled(*pair) for pair in zip(free, seeds, strict=True)])
    np.testing.assert_array_equal(unpacked(found, shape[1]), wanted)


def test_one_seed_does_for_all_maps():
    random = np.random.default_rng(1)
    free = random.random((3, 4, 12, 20)) < 0.7
    seed = np.zeros((12, 20), bool)
    seed[5:7, 8:12] = True
    found = unpacked(reached(packed(free), packed(seed)), 20)
    for index in np.ndindex(3, 4):
        np.testing.assert_array_equal(found[index], labelled(free[index], seed))


def test_columns_of_more_cells_than_a_word_has_bits_are_refused():
    with pytest.raises(ValueError, match="cells: expected at most 64 in a column, got"):
        packed(np.ones((3, 65), bool))
