"""Some rows of an online belief's table as a table of their own, and back again."""

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.history import History
from boomdp_jax.inference.likelihoods.target import StructureTarget

# A fit of so few rows that they fit into this share of the table is made on a table of
# that size: its cost is in proportion. More sizes would have to be compiled as well.
_SMALL_TABLE = 4


def table_sizes(capacity: int) -> tuple[int, int]:
    """Rows of the tables that fits are made on, for a table of some capacity."""
    return -(-capacity // _SMALL_TABLE), capacity


def windowed(history: History, begin: int, end: int, cut: int | None) -> History:
    """Take some rows into a table of their own.

    Args:
        history: the whole table.
        begin: first row.
        end: row after the last one.
        cut: row at which a track starts anew; None: as they do.

    Returns:
        A table of the same capacity, or of a quarter of it where that is enough.
    """
    num = end - begin
    capacity = min(size for size in table_sizes(history.capacity) if size >= num)

    def take(leaf: Array) -> Array:
        array = np.zeros((capacity, *leaf.shape[1:]), leaf.dtype)
        array[:num] = np.asarray(leaf)[begin:end]
        return on_device(array, array.dtype)

    window = jax.tree.map(take, history)
    dt = np.full(capacity, float(np.asarray(history.dt)[0]))
    dt[:num] = np.asarray(history.dt)[begin:end]
    episode = np.asarray(window.episode)
    if cut is not None:
        episode = episode + (np.arange(capacity) >= cut - begin)
    return eqx.tree_at(
        lambda h: (h.dt, h.episode),
        window,
        (on_device(dt, history.dt.dtype), on_device(episode, history.episode.dtype)),
    )


def in_whole_table(
    targets: StructureTarget, starts: np.ndarray, begin: int, capacity: int
) -> tuple[StructureTarget, np.ndarray]:
    """Put a fitted target's rows, and the states before them, at their places.

    Args:
        targets: of rows in a table of their own, one object.
        starts: state before each row, `[time, body, 6]`.
        begin: where the first row goes.
        capacity: of the whole table.
    """
    likelihood: Any = targets.log_likelihood
    data = likelihood.data

    def put(leaf: Array, axis: int) -> Array:
        array = np.moveaxis(np.asarray(leaf), axis, 0)[: capacity - begin]
        out = np.zeros((capacity, *array.shape[1:]), array.dtype)
        out[begin : begin + len(array)] = array
        return on_device(np.moveaxis(out, 0, axis), array.dtype)

    is_uniform = data.steps.dt.ndim == 1
    dt = data.steps.dt
    placed = jax.tree.map(
        lambda leaf: put(leaf, 1),
        eqx.tree_at(lambda d: d.steps.dt, data, data.is_start),
    )
    placed = eqx.tree_at(lambda d: d.steps.dt, placed, dt if is_uniform else put(dt, 1))
    gains = jax.tree.map(lambda leaf: put(leaf, 2), likelihood.gains)
    targets = eqx.tree_at(
        lambda t: (t.log_likelihood.data, t.log_likelihood.gains),
        targets,
        (placed, gains),
    )
    return targets, np.asarray(put(on_device(starts, starts.dtype), 0))
