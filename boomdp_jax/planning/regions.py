"""Where a robot can get to: regions of free cells on a grid, and ways through them.

Cells are free or not for the robot's middle; a region is a set of free cells that are
connected side by side. Ways go to the eight neighbours, but diagonally only between two
free cells, so that no corner is cut and a region is just what can be walked.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage, sparse
from scipy.sparse import csgraph

_STRAIGHT = np.array([[1, 0], [0, 1]])
_DIAGONAL = np.array([[1, 1], [1, -1]])


class Grid(NamedTuple):
    """Cells of a plane."""

    low: tuple[float, float]
    """Middle of the first cell [m]."""
    spacing: float
    """[m]"""
    shape: tuple[int, int]

    @property
    def places(self) -> Float[np.ndarray, "x y 2"]:
        """Middles of all cells [m]."""
        axes = [self.low[i] + self.spacing * np.arange(self.shape[i]) for i in range(2)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)

    def cell(
        self, place: Float[np.ndarray, "*any 2"] | tuple[float, float]
    ) -> Int[np.ndarray, "*any 2"]:
        """The cell that a place lies in, or the nearest one at the rim."""
        index = np.rint((np.asarray(place, float) - self.low) / self.spacing)
        return np.clip(index.astype(int), 0, np.array(self.shape) - 1)

    def place(self, cell: Int[np.ndarray, "*any 2"]) -> Float[np.ndarray, "*any 2"]:
        """Middle of a cell [m]."""
        return np.asarray(self.low) + self.spacing * np.asarray(cell)


def grid_between(
    low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"], spacing: float
) -> Grid:
    """Cells that cover a box.

    Args:
        low: least x and y [m].
        high: greatest x and y [m].
        spacing: between middles of cells [m].

    Raises:
        ValueError: a spacing that is not positive, or a box of fewer than two cells.
    """
    if not spacing > 0:
        raise ValueError(f"spacing: expected a positive length, got {spacing}")
    size = np.asarray(high, float) - np.asarray(low, float)
    counts = np.floor(size / spacing + 1e-9).astype(int) + 1
    if np.any(counts < 2):
        raise ValueError(
            f"high: expected beyond low by {spacing} at least, got {np.asarray(high)}"
        )
    shape = int(counts[0]), int(counts[1])
    return Grid((float(low[0]), float(low[1])), spacing, shape)


def label_regions(free: Bool[np.ndarray, "x y"]) -> tuple[Int[np.ndarray, "x y"], int]:
    """Number the regions.

    Args:
        free: cells where the robot's middle may be.

    Returns:
        Of each cell its region's number from one, zero where it is not free; and how
        many regions there are.
    """
    return ndimage.label(free)


class Ways(NamedTuple):
    """Shortest ways from one cell to all others."""

    grid: Grid
    length: Float[np.ndarray, "x y"]
    """Of the way to each cell [m]; infinite where there is none."""
    start: Int[np.ndarray, "2"]
    """Cell at which ways begin."""
    before: Int[np.ndarray, "cell"]
    """On that way, the flat index of the cell before; negative where there is none."""

    def path_to(self, cell: Int[np.ndarray, "2"]) -> Float[np.ndarray, "step 2"] | None:
        """Middles of the cells on the way, both ends included [m]; None: no way."""
        if not np.isfinite(self.length[tuple(cell)]):
            return None
        index = int(np.ravel_multi_index(tuple(cell), self.grid.shape))
        found = [index]
        while (index := int(self.before[index])) >= 0:
            found.append(index)
        cells = np.stack(np.unravel_index(found[::-1], self.grid.shape), axis=-1)
        return self.grid.place(cells)


def ways_from(
    grid: Grid, free: Bool[np.ndarray, "x y"], start: Int[np.ndarray, "2"]
) -> Ways:
    """Shortest ways over free cells (Dijkstra's algorithm).

    Args:
        grid: the cells.
        free: which may be walked; the start counts as free.
        start: where ways begin.

    Returns:
        The ways.
    """
    free = free.copy()
    free[tuple(start)] = True
    index = np.arange(free.size).reshape(free.shape)
    ends, lengths = [], []
    for step in (*_STRAIGHT, *_DIAGONAL):
        one, other = _neighbours(free, step)
        is_open = free[one] & free[other]
        if np.all(step != 0):
            # No corner is cut: both cells between have to be free.
            side = tuple(zip(one, other, strict=True))
            is_open &= free[side[0][0], side[1][1]] & free[side[0][1], side[1][0]]
        ends.append(np.stack([index[one][is_open], index[other][is_open]]))
        size = grid.spacing * np.hypot(*step)
        lengths.append(np.full(int(is_open.sum()), size))
    rows, columns = np.concatenate(ends, axis=1)
    graph = sparse.coo_matrix(
        (np.concatenate(lengths), (rows, columns)), shape=(free.size, free.size)
    ).tocsr()
    length, before = csgraph.dijkstra(
        graph,
        directed=False,
        indices=int(index[tuple(start)]),
        return_predecessors=True,
    )
    return Ways(grid, length.reshape(free.shape), np.asarray(start), before)


def _neighbours(free: np.ndarray, step: np.ndarray) -> tuple[tuple, tuple]:
    """Slices of all cells that have a neighbour so far on, and of these."""
    one, other = [], []
    for size, number in zip(free.shape, step, strict=True):
        number = int(number)
        one.append(slice(max(-number, 0), size - max(number, 0)))
        other.append(slice(max(number, 0), size - max(-number, 0)))
    return tuple(one), tuple(other)
