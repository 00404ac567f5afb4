"""The adapter of mctx: against enumeration, and without mctx."""

import importlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.planning import certain, mctx_search
from tests.planning import small_worlds as worlds

POLICIES = ["gumbel", "muzero"]


def plan_in_table(belief, state, policy="gumbel", **options):
    return mctx_search(
        jax.random.key(0),
        belief,
        jnp.asarray(state),
        **{
            "transition_fn": worlds.move_in_table,
            "reward_fn": worlds.table_reward,
            "leaf_fn": worlds.table_leaf,
            "actions": worlds.NUM_ACTIONS,
            "depth": 3,
            "discount": 0.9,
            "num_simulations": 400,
            "policy": policy,
        }
        | options,
    )


def test_missing_library_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mctx", None)
    with pytest.raises(ImportError, match="pip install mctx"):
        plan_in_table(certain(jnp.array([1.0, 0.0])), 0)


def test_unknown_policy_is_refused():
    with pytest.raises(ValueError, match=r"policy: expected one of .*; got 'uct'"):
        plan_in_table(certain(jnp.array([1.0, 0.0])), 0, policy="uct")


@pytest.fixture
def mctx():
    return pytest.importorskip("mctx")


@pytest.mark.slow
@pytest.mark.parametrize("policy", POLICIES)
def test_with_the_true_value_as_leaf_actions_are_good(mctx, policy):
    value = worlds.optimal_values(0.9)
    belief = certain(jnp.array([1.0, 0.0]))

    def plan_from(state):
        return plan_in_table(
            belief, state, policy, leaf_fn=lambda _, state: jnp.asarray(value)[state]
        )

    plans = jax.jit(jax.vmap(plan_from))(jnp.arange(worlds.NUM_STATES))
    for state in range(worlds.NUM_STATES):
        plan = jax.tree.map(lambda leaf, state=state: leaf[state], plans)
        returns = worlds.table_returns(state, 3, 0.9, leaf=value)
        best = worlds.best_by_first(returns)
        found = tuple(np.asarray(plan.sequence).tolist())
        assert found[0] == plan.index == plan.action
        # A mean over what was looked at: never better, and not by much worse than what
        # the worst action may cost.
        assert value[state] - 1.5 < plan.value <= value[state] + 1e-12
        if policy == "muzero":
            assert best[plan.index] == pytest.approx(value[state], abs=1e-12)
            assert returns[found] == pytest.approx(value[state], abs=1e-12)
        else:
            # Sequential halving takes one of two actions of nearly the same value;
            # the next best of the other states costs one at least.
            assert best[plan.index] > value[state] - 0.2


@pytest.mark.parametrize("policy", POLICIES)
def test_values_of_one_level_are_exact_and_averaged_by_weight(mctx, policy):
    hypotheses, weight = np.array([[1.0, 0.0], [-1.5, 0.2]]), np.array([0.7, 0.3])
    belief = (jnp.asarray(hypotheses), jnp.log(jnp.asarray(weight)))
    plan = plan_in_table(belief, 0, policy, depth=1, num_simulations=30)
    each = np.array(
        [
            worlds.best_by_first(worlds.table_returns(0, 1, 0.9, *numbers))
            for numbers in hypotheses
        ]
    )
    np.testing.assert_allclose(plan.hypothesis_q_values, each, atol=1e-12)
    np.testing.assert_allclose(plan.q_values, weight @ each, atol=1e-12)
    assert plan.value == plan.q_values[plan.index]


@pytest.mark.slow
def test_action_that_was_not_tried_has_the_worst_value_of_its_tree_or_none(mctx):
    belief = (jnp.array([[1.0, 0.0], [2.0, 0.0]]), jnp.zeros(2))
    plan = plan_in_table(belief, 0, "muzero", num_simulations=1)
    # Each tree tried one action: that is all it knows of any.
    is_tried = np.isfinite(plan.q_values)
    assert 1 <= is_tried.sum() <= 2
    assert is_tried[plan.index]
    values = np.asarray(plan.hypothesis_q_values)
    np.testing.assert_array_equal(np.isfinite(values), np.tile(is_tried, (2, 1)))
    for tree, scale in zip(values, (1.0, 2.0), strict=True):
        returns = worlds.best_by_first(worlds.table_returns(0, 1, 0.9, scale))
        assert np.ptp(tree[is_tried]) == 0.0
        assert np.min(np.abs(returns - tree[is_tried][0])) < 1e-12


def wager(key, hypothesis, state, action):
    del key, hypothesis, action
    return state, True


def pay_wager(hypothesis, state, action, next_state):
    del state, next_state
    return hypothesis[action]


@pytest.mark.slow
@pytest.mark.parametrize("policy", POLICIES)
def test_action_that_is_good_under_all_hypotheses_beats_the_favourite_of_each(
    mctx, policy
):
    pays = jnp.array([[1.0, 0.8, -1.0], [-1.0, 0.8, 1.0]])
    plan = plan_in_table(
        (pays, jnp.zeros(2)),
        0,
        policy,
        transition_fn=wager,
        reward_fn=pay_wager,
        leaf_fn=None,
        num_simulations=64,
    )
    np.testing.assert_allclose(plan.q_values, [0.0, 0.8, 0.0], atol=1e-12)
    assert plan.index == 1


def pay_for_every_step(hypothesis, state, action, next_state):
    """A little less for the last action, at the root."""
    del hypothesis, next_state
    return -1.0 + 0.1 * (state == 0) * (action == 3)


def count_steps(key, hypothesis, state, action):
    del key, hypothesis, action
    return state + 1, False


def test_action_that_few_simulations_reached_does_not_win_on_an_early_value(mctx):
    # With a leaf of zero where costs lie ahead, the less looked at the better.
    plan = plan_in_table(
        certain(jnp.ones(2)),
        0,
        transition_fn=count_steps,
        reward_fn=pay_for_every_step,
        leaf_fn=None,
        actions=4,
        depth=8,
        discount=1.0,
        num_simulations=64,
    )
    assert plan.index == 3
    assert plan.value == plan.q_values[3] < jnp.max(plan.q_values)


def test_library_is_not_loaded_before_it_is_used():
    module = importlib.import_module("boomdp_jax.planning.mctx_search")
    assert "mctx" not in vars(module)
