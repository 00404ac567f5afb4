"""How far it is to a goal round walls: a table of shortest ways on a grid.

Places in a wall, or nearer to one than a margin, are closed. From each other place a
way goes on to its eight neighbours, straight ones one spacing long and diagonal ones
√2, so that in the open a way is at most a twelfth longer than the straight one.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.envs.walls import Walls

_DEAR = 4.0
"""As how many metres one within a margin counts."""
_NEIGHBOURS = [(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if (x, y) != (0, 0)]


def way_to(
    walls: Walls,
    goal: Float[np.ndarray, "2"],
    low: Float[np.ndarray, "2"],
    high: Float[np.ndarray, "2"],
    *,
    margin: float,
    spacing: float = 0.1,
) -> Callable[[Float[Array, "2"]], FloatScalar]:
    """Fill the table from the goal, in NumPy.

    Args:
        walls: all of them.
        goal: where ways end [m].
        low: least x and y of the grid [m].
        high: greatest x and y of the grid [m].
        margin: how near a way may come to a wall [m].
        spacing: of the grid [m].

    Returns:
        Length of the way from a place [m], by interpolation; pure. From within a margin
        ways lead out of it, every metre there counting as several.

    Raises:
        ValueError: a spacing that is not positive, or a grid of fewer than two places.
    """
    if not spacing > 0:
        raise ValueError(f"spacing: expected a positive length, got {spacing}")
    counts = np.floor((np.asarray(high) - np.asarray(low)) / spacing).astype(int) + 1
    if np.any(counts < 2):
        raise ValueError(f"high: expected beyond low by {spacing} at least, got {high}")
    axes = [low[axis] + spacing * np.arange(counts[axis]) for axis in range(2)]
    place = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    middle, half = np.asarray(walls.middle), np.asarray(walls.half_extents) + margin
    away = np.abs(place[:, :, None] - middle) < half
    is_open = ~np.any(np.all(away, axis=-1), axis=-1)
    at = np.unravel_index(np.argmin(np.sum((place - goal) ** 2, axis=-1)), counts)
    way = np.full(counts, np.inf)
    way[at] = 0.0
    way = _relaxed(way, is_open, np.ones(counts))
    # From within a margin ways lead out; none leads through.
    way = _relaxed(way, ~is_open, np.full(counts, _DEAR))
    # A place that is walled in is farther than all others.
    way = spacing * np.where(np.isfinite(way), way, 2 * way[np.isfinite(way)].max())
    table = jnp.asarray(way, float)

    def length(place: Float[Array, "2"]) -> FloatScalar:
        where = (place - jnp.asarray(low, place.dtype)) / spacing
        where = jnp.clip(where, 0.0, jnp.asarray(counts, place.dtype) - 1.001)
        first = jnp.floor(where).astype(int)
        (i, j), (a, b) = first, where - first
        near = table[i, j] * (1 - a) * (1 - b) + table[i + 1, j] * a * (1 - b)
        far = table[i, j + 1] * (1 - a) * b + table[i + 1, j + 1] * a * b
        return (near + far).astype(place.dtype)

    return length


def _relaxed(
    way: Float[np.ndarray, "x y"],
    is_open: Bool[np.ndarray, "x y"],
    cost: Float[np.ndarray, "x y"],
) -> Float[np.ndarray, "x y"]:
    """Shortest ways over open places, begun with some that are known."""
    while True:
        padded = np.pad(way, 1, constant_values=np.inf)
        best = way
        for x, y in _NEIGHBOURS:
            near = padded[1 + x : 1 + x + len(way), 1 + y : 1 + y + way.shape[1]]
            best = np.minimum(best, near + cost * np.hypot(x, y))
        best = np.where(is_open, best, way)
        if np.array_equal(best, way):
            return way
        way = best
