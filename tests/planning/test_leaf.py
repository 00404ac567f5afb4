"""The value of following a policy, as a leaf."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.planning import certain, random_shooting, rollout_leaf
from tests.planning import small_worlds as worlds


def step_right(hypothesis, state):
    """As far as the hypothesis says."""
    del state
    return hypothesis[None]


def walk(key, hypothesis, state, action):
    del key, hypothesis
    return state + action[0], state + action[0] >= 4.0


def pay_position(hypothesis, state, action, next_state):
    del hypothesis, action
    return jnp.where(state < 4.0, next_state, jnp.nan)


def test_policy_is_followed_and_discounted():
    leaf = rollout_leaf(walk, pay_position, step_right, 3, 0.5)
    value = leaf(jnp.asarray(0.5), jnp.asarray(1.0))
    assert value == pytest.approx(1.5 + 0.5 * 2.0 + 0.25 * 2.5)


def test_nothing_counts_after_the_end():
    leaf = rollout_leaf(walk, pay_position, step_right, 6)
    # Ends at 4, the second position; the reward is NaN from there on.
    assert leaf(jnp.asarray(1.5), jnp.asarray(1.0)) == pytest.approx(2.5 + 4.0)


def test_optimal_policy_gives_the_optimal_value():
    start = np.array([1.0, -0.5])
    value, actions = worlds.riccati(start, 5)

    def look_up(hypothesis, state):
        index = jnp.argmin(jnp.abs(hypothesis[:, 0] - state[0]))
        return hypothesis[index, 1:]

    states = [start]
    for action in actions:
        states.append(worlds.DYNAMICS @ states[-1] + worlds.INPUT * action)
    table = jnp.array([[x[0], u] for x, u in zip(states, actions, strict=False)])

    def integrate(key, hypothesis, state, action):
        del hypothesis
        return worlds.integrate(key, 1.0, state, action)

    leaf = rollout_leaf(integrate, worlds.quadratic_reward, look_up, 5)
    paid = leaf(table, jnp.asarray(start))
    last = worlds.quadratic_leaf(None, jnp.asarray(states[-1]))
    assert paid + last == pytest.approx(value, abs=1e-9)


def test_noise_is_the_same_for_all_states_and_follows_the_key():
    def leaf(key):
        return rollout_leaf(worlds.drift, worlds.reach_right, step_right, 4, key=key)

    one, again, other = leaf(None), leaf(jax.random.key(0)), leaf(jax.random.key(1))
    here, there = jnp.asarray(0.0), jnp.asarray(2.0)
    still = jnp.asarray(1.0)
    assert one(still, here) == again(still, here) != other(still, here)
    assert one(still, there) - one(still, here) == pytest.approx(4 * 2.0)


def test_leaf_lengthens_a_plan_and_shares_its_program():
    num_traces = 0

    def counted(key, hypothesis, state, action):
        nonlocal num_traces
        num_traces += 1
        return walk(key, hypothesis, state, action)

    def plan(leaf_key, discount):
        return random_shooting(
            jax.random.key(0),
            certain(1.0),
            jnp.asarray(0.0),
            transition_fn=counted,
            reward_fn=pay_position,
            actions=jnp.ones((1, 1)),
            depth=2,
            leaf_fn=rollout_leaf(
                counted, pay_position, step_right, 9, discount, key=leaf_key
            ),
            num_samples=2,
        )

    # 1 and 2 by the plan, 3 and 4 by the policy, at 4 the end.
    assert plan(jax.random.key(0), 1.0).value == 10.0
    num_first = num_traces
    assert plan(jax.random.key(1), 0.5).value == 1.0 + 2.0 + 3.0 + 0.5 * 4.0
    assert num_traces == num_first


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="num_steps: expected a positive integer"):
        rollout_leaf(walk, pay_position, step_right, 0)
    with pytest.raises(ValueError, match="discount"):
        rollout_leaf(walk, pay_position, step_right, 1, 1.5)
