"""What is drawn of a tree: its nodes, its edges and the plan."""

import numpy as np
import pytest

from boomdp_jax.planning.tree_levels import TreeLevel
from boomdp_jax.viz import draw_tree


def test_nodes_edges_and_branch_are_drawn():
    figure = pytest.importorskip("matplotlib.figure").Figure()
    axes = figure.subplots()
    none = np.zeros((0, 2), int)
    levels = [
        TreeLevel(
            np.array([[0.0, 0.0]]),
            np.zeros(1),
            np.array([[0, 0], [0, 1], [0, 1]]),
            np.arange(3),
            0,
        ),
        TreeLevel(np.array([[1.0, 0.0], [1.0, 1.0]]), np.zeros(2), none, none, 1),
    ]
    points = draw_tree(axes, levels, lambda state: state)
    np.testing.assert_allclose(points.get_offsets(), [[0, 0], [1, 0], [1, 1]])
    np.testing.assert_array_equal(points.get_array(), [0, 1, 1])
    sizes = points.get_sizes()
    assert sizes[2] > sizes[1] == sizes[0]
    lines = [c for c in axes.collections if c is not points]
    assert len(lines[0].get_segments()) == 3
    np.testing.assert_allclose(axes.lines[0].get_xydata(), [[0, 0], [1, 1]])
