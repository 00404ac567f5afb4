"""Gradient ascent through the model: exact where the return is concave."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from boomdp_jax.planning import certain, gradient_shooting
from tests.planning import small_worlds as worlds

START = np.array([1.0, -0.5])


def plan_to_rest(**options):
    return gradient_shooting(
        jax.random.key(0),
        certain(1.0),
        jnp.asarray(START),
        **{
            "transition_fn": worlds.integrate,
            "reward_fn": worlds.quadratic_reward,
            "leaf_fn": worlds.quadratic_leaf,
            "actions": worlds.ACCELERATIONS,
            "depth": 5,
            "num_starts": 2,
            "num_steps": 400,
        }
        | options,
    )


def test_double_integrator_is_steered_as_riccati_says():
    plan = plan_to_rest()
    value, actions = worlds.riccati(START, 5)
    assert plan.value == pytest.approx(value, abs=1e-8)
    np.testing.assert_allclose(plan.sequence[:, 0], actions, atol=1e-4)


def test_another_optimiser_may_climb():
    plan = plan_to_rest(optimiser=optax.sgd(0.01, momentum=0.9))
    assert plan.value == pytest.approx(worlds.riccati(START, 5)[0], abs=1e-8)


def test_best_point_passed_is_returned_though_the_climb_went_on():
    # Steps so long that Adam leaps from edge to edge; nothing is as good as the middle,
    # where the climb begins.
    plan = plan_to_rest(
        num_starts=1, num_steps=3, learning_rate=5.0, actions=10 * worlds.ACCELERATIONS
    )
    np.testing.assert_array_equal(plan.sequence, np.zeros((5, 1)))


def stay(key, hypothesis, state, action):
    del key, hypothesis, action
    return state, False


def climb(reward_fn, **options):
    return gradient_shooting(
        jax.random.key(0),
        certain(1.0),
        0.0,
        **{
            "transition_fn": stay,
            "reward_fn": reward_fn,
            "actions": jnp.array([[-2.0], [2.0]]),
            "depth": 1,
            "num_starts": 16,
            "num_steps": 200,
        }
        | options,
    )


def beyond_the_edge(hypothesis, state, action, next_state):
    del hypothesis, state, next_state
    return -((action[0] - 3.0) ** 2)


def test_optimum_outside_the_box_is_met_at_the_edge():
    plan = climb(beyond_the_edge)
    assert plan.action[0] == 2.0
    assert plan.value == pytest.approx(-1.0)


def two_peaks(hypothesis, state, action, next_state):
    """Of heights 1 at −1 and 2 at 1.5, the middle on the slope of the lower one."""
    del hypothesis, state, next_state
    lower = jnp.exp(-((action[0] + 1.0) ** 2) / 0.3)
    return lower + 2.0 * jnp.exp(-((action[0] - 1.5) ** 2) / 0.05)


def test_several_starts_find_the_higher_of_two_peaks():
    one, many = climb(two_peaks, num_starts=1), climb(two_peaks)
    assert one.action[0] == pytest.approx(-1.0, abs=1e-3)
    assert many.action[0] == pytest.approx(1.5, abs=1e-3)
    assert many.value == pytest.approx(2.0, abs=1e-6)


def broken_slope(hypothesis, state, action, next_state):
    """Rises to the right, but its derivative is NaN left of zero."""
    del hypothesis, state, next_state
    hidden = jnp.sqrt(jnp.maximum(action[0], 0.0))
    return jnp.where(action[0] > 0, hidden, -1.0) + 0.0 * action[0]


def test_gradients_that_are_not_numbers_do_not_break_the_search():
    x = jnp.array([-1.0])
    assert np.isnan(jax.grad(lambda a: broken_slope(0, 0, a, 0))(x)[0])
    plan = climb(broken_slope)
    assert plan.action[0] == 2.0
    assert plan.value == pytest.approx(np.sqrt(2.0))
    # A single start has nothing to climb by, and stays in the middle.
    stuck = climb(broken_slope, num_starts=1)
    assert stuck.action[0] == 0.0
    assert stuck.value == -1.0


def half_broken(hypothesis, state, action, next_state):
    """Rises in the second number; the slope in the first is NaN everywhere."""
    del hypothesis, state, next_state
    zero = 0.0 * action[0]
    return jnp.where(zero == 0, 0.0, jnp.sqrt(zero)) + action[1]


def test_what_is_sound_of_a_gradient_is_used():
    actions = jnp.array([[-2.0, -2.0], [2.0, 2.0]])
    plan = climb(half_broken, actions=actions, num_starts=1)
    assert plan.action.tolist() == [0.0, 2.0]


def test_previous_plan_is_where_the_search_starts():
    found = plan_to_rest()
    # So short a step leads nowhere.
    again = plan_to_rest(num_starts=1, num_steps=1, learning_rate=1e-9, previous=found)
    expected = jnp.concatenate([found.sequence[1:], found.sequence[-1:]])
    np.testing.assert_allclose(again.sequence, expected, atol=1e-6)


def test_rate_that_is_not_positive_is_refused():
    with pytest.raises(ValueError, match="learning_rate: expected a number above 0"):
        plan_to_rest(learning_rate=0.0)
