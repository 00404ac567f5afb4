"""A tree that was kept, level by level, on the host: to be looked at."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from boomdp_jax.planning.plan import Plan


class TreeLevel(NamedTuple):
    """The nodes of one level, without the places that nobody took."""

    state: PyTree
    """NumPy arrays, leading axis `node`."""
    value: np.ndarray
    """Of each node `[node]`; −∞ where all that follows was dropped."""
    edge: np.ndarray
    """Node here and node of the next level, of every child that has a place
    `[edge, 2]`; several edges to one node are what merging saved."""
    action: np.ndarray
    """Which action each edge is `[edge]`."""
    chosen: int
    """The node that the plan passes through; −1 after its end."""


def tree_levels(plan: Plan, hypothesis: int = 0) -> list[TreeLevel]:
    """Take a plan's tree apart.

    Args:
        plan: of `sparse_sampling` with `keep_tree=True`.
        hypothesis: whose tree, of those at the root.

    Returns:
        The levels, from the root on. The chosen branch is the one that is best under
        this hypothesis after the plan's first action.

    Raises:
        ValueError: a plan without a tree that was kept, or no such hypothesis.
    """
    records = getattr(plan.tree, "records", None)
    if records is None or records[0].nodes is None:
        raise ValueError(
            "plan: expected one of sparse_sampling with keep_tree=True, and not with "
            f"'adaptive' hypotheses; got a tree of type {type(plan.tree).__name__}"
        )
    num = records[0].num_nodes.shape[0]
    if not 0 <= hypothesis < num:
        raise ValueError(f"hypothesis: expected one of {num}; got {hypothesis}")
    tree = jax.tree.map(lambda leaf: np.asarray(leaf[hypothesis]), plan.tree)
    stacked = [*zip(tree.records, tree.backed, strict=True)]
    flat = [level for run in stacked for level in _unstacked(*run)]
    levels, node, action = [], 0, int(plan.index)
    for number, (record, backed) in enumerate(flat):
        exists = record.nodes.exists
        here = np.cumsum(exists) - 1
        has_below = number + 1 < len(flat)
        parent, which, draw = np.nonzero(
            (record.place >= 0) & exists[:, None, None] & has_below
        )
        below = record.place[parent, which, draw]
        if has_below:
            there = np.cumsum(flat[number + 1][0].nodes.exists) - 1
            edge = np.stack([here[parent], there[below]], axis=1)
        else:
            edge = np.zeros((0, 2), int)
        levels.append(
            TreeLevel(
                jax.tree.map(lambda leaf, on=exists: leaf[on], record.nodes.state),
                backed.value[exists],
                edge,
                which,
                int(here[node]) if node >= 0 else -1,
            )
        )
        if node >= 0 and has_below:
            if number:
                action = int(np.argmax(backed.q_values[node]))
            places = record.place[node, action]
            places = places[places >= 0]
            node = int(places[0]) if len(places) else -1
    return levels


def _unstacked(record, backed) -> list[tuple]:
    """Levels of a run, each with its values."""
    if record.place.ndim == 3:
        return [(record, backed)]
    return [
        jax.tree.map(lambda leaf, i=i: leaf[i], (record, backed))
        for i in range(len(record.place))
    ]
