"""Random shooting: with enough samples it is enumeration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.planning import certain, random_shooting
from tests.planning import small_worlds as worlds


def plan_in_table(seed, belief, **options):
    # Of 27 sequences, one is missed by 1024 draws once in 2e15 times.
    return random_shooting(
        jax.random.key(seed),
        belief,
        0,
        **{
            "transition_fn": worlds.move_in_table,
            "reward_fn": worlds.table_reward,
            "leaf_fn": worlds.table_leaf,
            "actions": worlds.NUM_ACTIONS,
            "depth": 3,
            "discount": 0.9,
            "num_samples": 1024,
        }
        | options,
    )


@pytest.mark.parametrize("repeat", [1, 2])
def test_best_of_all_sequences_is_found(repeat):
    plan = plan_in_table(0, certain(jnp.array([1.0, 0.0])), action_repeat=repeat)
    returns = worlds.table_returns(0, 3, 0.9, repeat=repeat)
    best = max(returns.values())
    # Not which: where the episode ends before the horizon there are several.
    found = tuple(np.asarray(plan.sequence).tolist())
    assert returns[found] == pytest.approx(best, abs=1e-12)
    assert plan.value == pytest.approx(best, abs=1e-12)
    assert plan.index == plan.action == found[0]
    np.testing.assert_allclose(plan.q_values, worlds.best_by_first(returns), atol=1e-12)


def test_best_on_average_over_hypotheses_is_found():
    hypotheses, weight = np.array([[1.0, 0.0], [-1.5, 0.2]]), np.array([0.6, 0.4])
    plan = plan_in_table(1, (jnp.asarray(hypotheses), jnp.log(jnp.asarray(weight))))
    each = [worlds.table_returns(0, 3, 0.9, *numbers) for numbers in hypotheses]
    mean = {
        sequence: weight[0] * each[0][sequence] + weight[1] * each[1][sequence]
        for sequence in each[0]
    }
    found = tuple(np.asarray(plan.sequence).tolist())
    assert mean[found] == pytest.approx(max(mean.values()), abs=1e-12)
    assert plan.value == pytest.approx(max(mean.values()), abs=1e-12)
    np.testing.assert_allclose(plan.q_values, worlds.best_by_first(mean), atol=1e-12)
    np.testing.assert_allclose(
        weight @ np.asarray(plan.hypothesis_q_values), plan.q_values, atol=1e-12
    )


def test_action_that_was_not_tried_has_no_value():
    plan = plan_in_table(0, certain(jnp.array([1.0, 0.0])), num_samples=1)
    assert np.isfinite(plan.q_values).sum() == 1
    np.testing.assert_array_equal(np.isfinite(plan.q_values).nonzero()[0], plan.index)
    assert np.isfinite(plan.hypothesis_q_values).sum() == 1


def test_actions_may_be_any_pytree():
    actions = {"right": jnp.array([0.0, 1.0]), "is_on": jnp.array([True, False])}

    def move(key, hypothesis, state, action):
        del key, hypothesis
        return state + jnp.where(action["is_on"], 2.0, action["right"]), False

    plan = random_shooting(
        jax.random.key(0),
        certain(0.0),
        0.0,
        transition_fn=move,
        reward_fn=worlds.reach_right,
        actions=actions,
        depth=2,
        num_samples=64,
    )
    # Two and four.
    assert plan.value == 6.0
    assert plan.action == {"right": 0.0, "is_on": True}
    np.testing.assert_array_equal(plan.sequence["is_on"], [True, True])
