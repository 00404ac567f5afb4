"""Regions and ways against searches in plain Python."""

import heapq
import math

import numpy as np
import pytest

from boomdp_jax.planning import Grid, grid_between, label_regions, ways_from

SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1))
CORNERS = ((1, 1), (1, -1), (-1, 1), (-1, -1))


def random_maps():
    """Of many sizes, from nearly empty to nearly full."""
    random = np.random.default_rng(0)
    for _ in range(40):
        shape = tuple(random.integers(2, 14, 2))
        yield random, random.random(shape) < random.uniform(0.3, 0.95)


def is_free(free, cell):
    return all(0 <= i < n for i, n in zip(cell, free.shape, strict=True)) and free[cell]


def flooded(free, start):
    """Breadth first, side by side."""
    found, rim = {start}, [start]
    while rim:
        around = {(x + i, y + j) for x, y in rim for i, j in SIDES}
        rim = [cell for cell in around if is_free(free, cell) and cell not in found]
        found.update(rim)
    return found


def shortest(free, start):
    """Dijkstra's algorithm, cell by cell."""
    length, rim = {}, [(0.0, start)]
    while rim:
        so_far, (x, y) = heapq.heappop(rim)
        if (x, y) in length:
            continue
        length[x, y] = so_far
        for i, j in (*SIDES, *CORNERS):
            between = ((x + i, y), (x, y + j), (x + i, y + j))
            if all(is_free(free, cell) for cell in between):
                heapq.heappush(rim, (so_far + math.hypot(i, j), (x + i, y + j)))
    return length


def test_regions_are_what_breadth_first_search_finds():
    for _, free in random_maps():
        labels, num = label_regions(free)
        assert set(np.unique(labels[free])) == set(range(1, num + 1))
        assert not labels[~free].any()
        for region in range(1, num + 1):
            cells = set(map(tuple, np.argwhere(labels == region).tolist()))
            assert cells == flooded(free, next(iter(cells)))


def test_ways_are_shortest_and_cut_no_corner():
    for random, free in random_maps():
        grid = Grid((-1.0, 2.0), 0.25, free.shape)
        start = tuple(int(random.integers(n)) for n in free.shape)
        ways = ways_from(grid, free, np.array(start))
        # A robot is where it is, whatever the map says.
        walked = free.copy()
        walked[start] = True
        wanted = shortest(walked, start)
        for cell in np.ndindex(free.shape):
            path = ways.path_to(np.array(cell))
            if cell not in wanted:
                assert path is None
                assert ways.length[cell] == math.inf
                continue
            assert abs(ways.length[cell] - 0.25 * wanted[cell]) < 1e-9
            steps = np.diff(path, axis=0)
            length = np.sum(np.linalg.norm(steps, axis=1))
            assert abs(length - ways.length[cell]) < 1e-9
            cells = grid.cell(path)
            assert tuple(cells[0]) == start
            assert tuple(cells[-1]) == cell
            for (x, y), (i, j) in zip(cells, np.diff(cells, axis=0), strict=False):
                assert max(abs(i), abs(j)) == 1
                assert walked[x + i, y]
                assert walked[x, y + j]
                assert walked[x + i, y + j]


def test_a_region_is_what_can_be_walked():
    for _, free in random_maps():
        if not free.any():
            continue
        start = np.argwhere(free)[0]
        length = ways_from(Grid((0.0, 0.0), 1.0, free.shape), free, start).length
        labels, _ = label_regions(free)
        np.testing.assert_array_equal(
            np.isfinite(length), labels == labels[tuple(start)]
        )


def test_cells_cover_a_box_and_are_found_by_the_places_in_them():
    grid = grid_between(np.array([-1.0, 0.5]), np.array([1.0, 1.6]), 0.25)
    assert grid.shape == (9, 5)
    np.testing.assert_allclose(grid.places[0, 0], [-1.0, 0.5])
    np.testing.assert_allclose(grid.places[-1, -1], [1.0, 1.5])
    cells = np.argwhere(np.ones(grid.shape, bool))
    random = np.random.default_rng(0)
    within = random.uniform(-0.12, 0.12, (len(cells), 2))
    np.testing.assert_array_equal(grid.cell(grid.place(cells) + within), cells)
    np.testing.assert_allclose(grid.place(cells), grid.places.reshape(-1, 2))
    # Beyond the rim it is the nearest cell.
    outside = np.array([[-9.0, 0.9], [9.0, 9.0]])
    np.testing.assert_array_equal(grid.cell(outside), [[0, 2], [8, 4]])


@pytest.mark.parametrize("spacing", [0.0, -1.0, math.nan])
def test_cells_without_a_size_are_refused(spacing):
    with pytest.raises(ValueError, match="spacing: expected a positive length, got"):
        grid_between(np.zeros(2), np.ones(2), spacing)


def test_a_box_of_a_single_cell_is_refused():
    with pytest.raises(ValueError, match=r"high: expected beyond low by 0\.5 at least"):
        grid_between(np.zeros(2), np.array([1.0, 0.4]), 0.5)
