"""Plans made of sequences, and starts made of plans."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.planning.belief import Belief
from boomdp_jax.planning.problem import make_problem
from boomdp_jax.planning.rollouts import draw_rollouts
from boomdp_jax.planning.sequence_plan import (
    plan_of_indices,
    plan_of_vectors,
    shifted,
)
from tests.planning.small_worlds import drift, move_in_table, reach_right, table_reward


@pytest.fixture(scope="module")
def listed_plan():
    problem = make_problem(
        move_in_table, table_reward, {"push": jnp.array([10.0, 11.0, 12.0])}
    )
    belief = Belief(jnp.ones((2, 2)), jnp.log(jnp.array([3.0, 1.0])))
    rollouts = draw_rollouts(jax.random.key(0), problem, belief, jnp.asarray(0), 2, 2)
    indices = jnp.array([[0, 1], [2, 0], [0, 2], [2, 2]])
    returns = jnp.array([[4.0, 0.0], [-jnp.inf, 1.0], [0.0, 20.0], [-jnp.inf, 1.0]])
    return problem, eqx.filter_jit(plan_of_indices)(rollouts, indices, returns)


def test_best_sequence_is_planned_and_each_action_valued_by_its_best(listed_plan):
    _, plan = listed_plan
    # Means of the returns: 3, −∞, 5, −∞; the second action is not tried.
    assert plan.index == 0
    assert plan.value == 5.0
    assert plan.action["push"] == 10.0
    np.testing.assert_array_equal(plan.sequence["push"], [10.0, 12.0])
    np.testing.assert_array_equal(plan.q_values, [5.0, -np.inf, -np.inf])
    np.testing.assert_array_equal(
        plan.hypothesis_q_values, [[0.0, -np.inf, -np.inf], [20.0, -np.inf, 1.0]]
    )
    assert plan.info.num_model_calls == 4 * 2 * 2


def test_next_start_leaves_out_what_was_done(listed_plan):
    problem, plan = listed_plan
    np.testing.assert_array_equal(shifted(plan, problem, 2)["push"], [12.0, 12.0])
    assert shifted(None, problem, 2) is None


def test_plan_of_another_depth_or_of_other_actions_is_refused(listed_plan):
    problem, plan = listed_plan
    with pytest.raises(ValueError, match="previous: expected a plan of 3 levels"):
        shifted(plan, problem, 3)
    other = make_problem(move_in_table, table_reward, {"push": jnp.ones((3, 2))})
    with pytest.raises(ValueError, match="previous: expected a plan of 2 levels of th"):
        shifted(plan, other, 2)


def test_vectors_name_the_listed_action_next_to_the_first():
    listed = jnp.array([[-1.0], [0.0], [1.0]])
    problem = make_problem(drift, reach_right, listed)
    belief = Belief(jnp.ones(2), jnp.zeros(2))
    rollouts = draw_rollouts(jax.random.key(0), problem, belief, jnp.asarray(0.0), 2, 2)
    sequence = jnp.array([[0.4], [0.9]])
    plan = plan_of_vectors(rollouts, sequence, jnp.asarray(7.0), 5)
    assert plan.index == 1
    assert plan.value == 7.0
    np.testing.assert_array_equal(plan.action, [0.4])
    assert plan.q_values is None
    assert plan.info.num_model_calls == 5 * 2 * 2
