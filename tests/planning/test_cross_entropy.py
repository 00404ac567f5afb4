"""The cross-entropy method on problems with known optima."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.planning import certain, cross_entropy_method
from tests.planning import small_worlds as worlds

START = np.array([1.0, -0.5])


def plan_to_rest(**options):
    return cross_entropy_method(
        jax.random.key(0),
        certain(1.0),
        jnp.asarray(START),
        **{
            "transition_fn": worlds.integrate,
            "reward_fn": worlds.quadratic_reward,
            "leaf_fn": worlds.quadratic_leaf,
            "actions": worlds.ACCELERATIONS,
            "depth": 5,
            "num_samples": 200,
            "num_iterations": 12,
            "min_sd": 0.0,
        }
        | options,
    )


def test_double_integrator_is_steered_as_riccati_says():
    plan = plan_to_rest()
    value, actions = worlds.riccati(START, 5)
    # Never better than the optimum, and a thousandth from it.
    assert value * 1.001 < plan.value <= value + 1e-12
    np.testing.assert_allclose(plan.sequence[:, 0], actions, atol=0.05)
    np.testing.assert_allclose(plan.action, plan.sequence[0])
    assert plan.q_values is None


def beyond_the_edge(hypothesis, state, action, next_state):
    del hypothesis, state, next_state
    return -((action[0] - 5.0) ** 2)


def test_what_leaves_the_box_is_moved_to_its_edge():
    plan = plan_to_rest(reward_fn=beyond_the_edge, leaf_fn=None)
    np.testing.assert_array_equal(plan.sequence, np.full((5, 1), 3.0))
    assert plan.value == -20.0


@pytest.mark.slow
def test_least_spread_keeps_the_search_going():
    # One elite draw leaves no spread: without smoothing nothing new is drawn.
    options = {"elite_fraction": 0.005, "smoothing": 0.0, "num_iterations": 40}
    once = plan_to_rest(**options | {"num_iterations": 1})
    frozen = plan_to_rest(**options)
    kept = plan_to_rest(**options, min_sd=0.05)
    value, _ = worlds.riccati(START, 5)
    # Half as far from the optimum at least; and the best ever seen is never lost.
    assert value - kept.value < 0.5 * (value - frozen.value)
    assert once.value <= frozen.value


def table_plan(seed, **options):
    return cross_entropy_method(
        jax.random.key(seed),
        certain(jnp.array([1.0, 0.0])),
        0,
        **{
            "transition_fn": worlds.move_in_table,
            "reward_fn": worlds.table_reward,
            "leaf_fn": worlds.table_leaf,
            "actions": worlds.NUM_ACTIONS,
            "depth": 4,
            "discount": 0.9,
            "num_samples": 300,
            "num_iterations": 5,
            "smoothing": 0.5,
            "continuous": False,
        }
        | options,
    )


def test_listed_actions_are_chosen_as_by_enumeration():
    plan = table_plan(0)
    returns = worlds.table_returns(0, 4, 0.9)
    assert plan.value == pytest.approx(max(returns.values()), abs=1e-12)
    found = tuple(np.asarray(plan.sequence).tolist())
    assert returns[found] == pytest.approx(max(returns.values()), abs=1e-12)
    assert jnp.max(plan.q_values) == plan.value
    # Of each action something was seen, nothing better than its best.
    assert np.all(np.isfinite(plan.q_values))
    assert np.all(plan.q_values <= worlds.best_by_first(returns) + 1e-12)


def test_listed_actions_refit_to_the_elite():
    # Sixty levels of which each pays by itself: blind draws reach about half of it.
    def stay(key, hypothesis, state, action):
        del key, hypothesis, action
        return state, False

    def pay(hypothesis, state, action, next_state):
        del hypothesis, state, next_state
        return action

    options = {"transition_fn": stay, "reward_fn": pay, "leaf_fn": None}
    plan = table_plan(
        0, **options, depth=60, discount=1.0, num_iterations=25, smoothing=0.2
    )
    # Two for each; a sequence of 60 blind draws has 60 ± 6.3, and 7500 of them reach
    # 90 with probability 7500 · 1e-6.
    assert plan.value > 110.0


@pytest.mark.parametrize("continuous", [True, False])
def test_previous_plan_is_where_the_search_starts(continuous):
    options = {"continuous": continuous, "depth": 5}
    found = plan_to_rest(**options)
    # A single draw is the start itself.
    again = plan_to_rest(**options, num_samples=1, num_iterations=1, previous=found)
    expected = jnp.concatenate([found.sequence[1:], found.sequence[-1:]])
    np.testing.assert_allclose(again.sequence, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("elite_fraction", 0.0),
        ("elite_fraction", 1.1),
        ("smoothing", 1.0),
        ("smoothing", -0.1),
        ("min_sd", -0.1),
    ],
)
def test_numbers_outside_their_range_are_refused(option, value):
    with pytest.raises(ValueError, match=f"{option}: expected a number"):
        plan_to_rest(**{option: value})


def test_previous_plan_of_another_depth_is_refused():
    with pytest.raises(ValueError, match="previous: expected a plan of 4 levels"):
        plan_to_rest(depth=4, previous=plan_to_rest())
