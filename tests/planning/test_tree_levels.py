"""Levels of a kept tree against what is known of a walk on a line."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.planning import certain, sparse_sampling, tree_levels

WALK = {
    "transition_fn": lambda key, hypothesis, state, action: (state + action, False),
    "reward_fn": lambda hypothesis, state, action, after: -jnp.abs(after - 3.0),
    "actions": jnp.array([-1.0, 0.0, 1.0]),
    "depth": 6,
    "cell_size": 1.0,
}


@pytest.fixture(scope="module")
def levels():
    plan = sparse_sampling(
        jax.random.key(0), certain(0.0), jnp.asarray(0.0), keep_tree=True, **WALK
    )
    return tree_levels(plan)


@pytest.mark.slow
def test_levels_are_the_places_that_a_walk_can_reach(levels):
    assert len(levels) == 6
    for number, level in enumerate(levels):
        np.testing.assert_array_equal(
            np.sort(level.state), np.arange(-number, number + 1.0)
        )


@pytest.mark.slow
def test_edges_join_neighbours_and_meet_where_nodes_merged(levels):
    for number, (level, below) in enumerate(itertools.pairwise(levels)):
        start, end = level.state[level.edge[:, 0]], below.state[level.edge[:, 1]]
        np.testing.assert_array_equal(end - start, level.action - 1.0)
        assert len(level.edge) == 3 * (2 * number + 1)
    assert len(levels[-1].edge) == 0


@pytest.mark.slow
def test_values_and_the_chosen_branch_are_those_of_the_best_walk(levels):
    # By hand: three steps to 3, then stay: −2, −1, 0, 0, 0, 0.
    assert levels[0].value[0] == pytest.approx(-3.0)
    branch = [float(level.state[level.chosen]) for level in levels]
    assert branch == [0.0, 1.0, 2.0, 3.0, 3.0, 3.0]


def test_a_plan_without_a_tree_is_refused():
    plan = sparse_sampling(jax.random.key(0), certain(0.0), jnp.asarray(0.0), **WALK)
    with pytest.raises(ValueError, match="keep_tree=True"):
        tree_levels(plan)
