"""The box around listed actions, and the nearest of them."""

import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.planning.action_box import action_box, nearest
from boomdp_jax.planning.problem import make_problem
from tests.planning.small_worlds import move_in_table, table_reward

# The second number never varies.
ACTIONS = jnp.array([[-2.0, 7.0], [0.0, 7.0], [6.0, 7.0]])


def test_box_reaches_to_the_outermost_actions():
    box = action_box(ACTIONS)
    corners = box.actions(jnp.array([[-1.0, -1.0], [1.0, 1.0]]))
    np.testing.assert_allclose(corners, [[-2.0, 7.0], [6.0, 7.0]])


def test_coordinates_undo_actions_and_end_at_the_edge():
    box = action_box(ACTIONS)
    z = box.coordinates(jnp.array([[4.0, 7.0], [100.0, 7.0], [-2.0, 7.0]]))
    np.testing.assert_allclose(z, [[0.5, 0.0], [1.0, 0.0], [-1.0, 0.0]])


@pytest.mark.parametrize(
    "actions",
    [
        jnp.arange(3.0),
        jnp.arange(6).reshape(3, 2),
        {"push": jnp.ones((3, 2))},
        (jnp.ones((3, 2)),),
    ],
)
def test_actions_that_span_no_box_are_refused(actions):
    with pytest.raises(ValueError, match=r"one array of floats \[action, dim\]; got"):
        action_box(actions)


def test_nearest_measures_each_number_by_its_range():
    listed = jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1000.0]])
    problem = make_problem(move_in_table, table_reward, listed)
    # 600 is farther from 0 than from 1000, but 0.1 of one range less far than 0.9.
    assert nearest(problem, jnp.array([0.9, 600.0])) == 1
    assert nearest(problem, jnp.array([0.4, 0.0])) == 0
    assert nearest(problem, jnp.array([0.6, 900.0])) == 2


def test_nearest_of_a_pytree_finds_each_of_its_actions():
    listed = {
        "kind": jnp.array([0, 1, 1]),
        "is_on": jnp.array([True, True, False]),
        "push": jnp.array([[0.0, 1.0], [2.0, 1.0], [2.0, 1.0]]),
    }
    problem = make_problem(move_in_table, table_reward, listed)
    found = [int(nearest(problem, problem.action(i))) for i in range(3)]
    assert found == [0, 1, 2]
