"""A planner's tree in the plane: nodes by level, what merged, and the chosen branch."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from boomdp_jax.planning.tree_levels import TreeLevel

_SMALLEST, _LARGEST = 6.0, 60.0


def draw_tree(
    axes: Any,
    levels: Sequence[TreeLevel],
    place_fn: Callable[[Any], Any],
    *,
    colour_map: str = "viridis",
) -> Any:
    """Draw a tree over two coordinates of its states.

    A node's colour is its level; its area grows with the number of paths that merged in
    it. The branch that the plan follows is drawn on top.

    Args:
        axes: matplotlib axes.
        levels: of `tree_levels`.
        place_fn: `state -> (x, y)` of one node's state.
        colour_map: matplotlib's name of one.

    Returns:
        The points of the nodes, as a colour bar wants them.
    """
    from matplotlib.collections import LineCollection

    places = [_places(level, place_fn) for level in levels]
    segments = [
        np.stack([here[level.edge[:, 0]], below[level.edge[:, 1]]], axis=1)
        for level, here, below in zip(levels, places, places[1:], strict=False)
        if len(level.edge)
    ]
    if segments:
        lines = LineCollection(
            list(np.concatenate(segments)),
            colors="0.6",
            linewidths=0.4,
            alpha=0.5,
            zorder=1,
        )
        axes.add_collection(lines)
    counts = [np.ones(1)] + [
        np.bincount(level.edge[:, 1], minlength=len(below))
        for level, below in zip(levels, places[1:], strict=False)
    ]
    merged = np.concatenate(counts)
    points = axes.scatter(
        *np.concatenate(places).T,
        c=np.repeat(np.arange(len(levels)), [len(place) for place in places]),
        s=_SMALLEST + (_LARGEST - _SMALLEST) * (merged - 1) / max(merged.max() - 1, 1),
        cmap=colour_map,
        linewidths=0,
        zorder=2,
    )
    branch = [
        place[level.chosen]
        for level, place in zip(levels, places, strict=True)
        if level.chosen >= 0
    ]
    axes.plot(*np.array(branch).T, color="crimson", linewidth=2.0, zorder=3)
    axes.plot(*branch[0], "o", color="crimson", markersize=7, zorder=3)
    axes.set_aspect("equal")
    return points


def _places(level: TreeLevel, place_fn: Callable[[Any], Any]) -> np.ndarray:
    """Where the nodes of a level are `[node, 2]`."""
    num = len(level.value)
    nodes = [jax.tree.map(lambda leaf, i=i: leaf[i], level.state) for i in range(num)]
    return np.array([place_fn(node) for node in nodes], float).reshape(num, 2)
