"""Merging against `numpy.unique`, and what each policy keeps."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.planning.grid import hash_of
from boomdp_jax.planning.merging import OVERFLOW_POLICIES, merge


def random_children(seed, num=300):
    rng = np.random.default_rng([43, seed])
    cell = rng.integers(-6, 6, (num, 2))
    return (
        cell.astype(np.int32),
        np.floor(cell / 4).astype(np.int32),
        rng.standard_normal(num),
        rng.uniform(size=num) < 0.8,
    )


def merged_of(seed, capacity, policy="stratified"):
    cell, stratum, score, exists = random_children(seed)
    parts = (jnp.asarray(part) for part in (cell, stratum, score, exists))
    found = merge(jax.random.key(seed), *parts, capacity=capacity, policy=policy)
    found = jax.tree.map(np.asarray, found)
    return (cell, stratum, score, exists), found


@pytest.mark.parametrize("policy", OVERFLOW_POLICIES)
@pytest.mark.parametrize("capacity", [300, 200, 40, 1])
def test_every_child_points_to_its_cell(policy, capacity):
    (cell, _, score, exists), found = merged_of(1, capacity, policy)
    cells = np.unique(cell[exists], axis=0)
    num_taken = min(len(cells), capacity)
    assert found.exists.sum() == num_taken
    assert found.num_merged == exists.sum() - len(cells)
    assert found.num_dropped == len(cells) - num_taken
    has_place = found.place >= 0
    assert not np.any(has_place & ~exists)
    kept = cell[found.child]
    np.testing.assert_array_equal(kept[found.place[has_place]], cell[has_place])
    places = found.place[has_place]
    assert set(places) == set(np.flatnonzero(found.exists))
    # The best of a cell stands for it, and all of a kept cell's children have a place.
    for place in np.flatnonzero(found.exists):
        same = exists & np.all(cell == kept[place], axis=1)
        assert score[found.child[place]] == score[same].max()
        assert np.all(found.place[same] == place)


def leaders(cell, score, exists):
    """The best child of each cell."""
    best = {}
    for child in np.flatnonzero(exists):
        name = tuple(cell[child])
        if name not in best or score[child] > score[best[name]]:
            best[name] = child
    return np.array(list(best.values()))


def test_bound_keeps_the_best():
    (cell, _, score, exists), found = merged_of(2, 30, "bound")
    expected = sorted(score[leaders(cell, score, exists)])[-30:]
    np.testing.assert_allclose(np.sort(score[found.child]), expected)


def test_first_keeps_the_first():
    (cell, _, score, exists), found = merged_of(3, 30, "first")
    expected = np.sort(leaders(cell, score, exists))[:30]
    np.testing.assert_array_equal(np.sort(found.child), expected)


def test_stratified_takes_turns():
    (cell, stratum, score, exists), found = merged_of(4, 30)
    by_stratum = {}
    for child in leaders(cell, score, exists):
        by_stratum.setdefault(tuple(stratum[child]), []).append(child)
    ranks = {}
    for members in by_stratum.values():
        for rank, child in enumerate(sorted(members, key=lambda c: -score[c])):
            ranks[child] = (rank, -score[child])
    expected = sorted(ranks, key=ranks.get)[:30]
    assert set(found.child) == set(expected)


def test_random_keeps_all_alike():
    kept = np.zeros(300)
    cell, stratum, score, exists = (jnp.asarray(p) for p in random_children(5))
    merged = jax.jit(functools.partial(merge, capacity=30, policy="random"))
    for number in range(300):
        found = merged(jax.random.key(number), cell, stratum, score, exists)
        kept[np.asarray(found.child)] += 1
    best = leaders(*(np.asarray(part) for part in (cell, score, exists)))
    assert kept.sum() == kept[best].sum()
    # Counts of 300 draws of 30 out of so many; 5 sds, one of a million each.
    share = 30 / len(best)
    sd = np.sqrt(300 * share * (1 - share))
    assert np.all(np.abs(kept[best] - 300 * share) < 5 * sd)


def test_cells_of_one_hash_stay_apart():
    # Forged: all cells have the hash of the last place, as children that do not exist.
    num = 50
    cell = jnp.arange(num, dtype=jnp.int32)[:, None] % 10
    import boomdp_jax.planning.merging as module

    original = module.hash_of
    module.hash_of = lambda cells: jnp.full(cells.shape[0], 7, jnp.uint32)
    try:
        found = merge(
            jax.random.key(0),
            cell,
            cell,
            jnp.arange(num, dtype=float),
            jnp.ones(num, bool),
            capacity=num,
            policy="bound",
        )
    finally:
        module.hash_of = original
    kept = np.asarray(cell)[np.asarray(found.child)]
    np.testing.assert_array_equal(kept[np.asarray(found.place)], cell)


def test_hashes_of_a_grid_are_all_different():
    side = np.arange(-40, 40)
    cells = np.stack(np.meshgrid(side, side, [0, 1]), axis=-1).reshape(-1, 3)
    hashes = np.unique(np.asarray(hash_of(jnp.asarray(cells, jnp.int32))))
    # Of 12,800 a random hash would lose 0.02.
    assert len(cells) - len(hashes) <= 1
