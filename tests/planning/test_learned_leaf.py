"""A leaf value that is learnt from values of states."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.planning import certain, learned_leaf, random_shooting
from tests.planning import small_worlds as worlds

KEY = jax.random.key(0)
HORIZON = 4


@pytest.fixture(scope="module")
def leaf():
    """Learnt from what Riccati's recursion says of states up to 2 m and 2 m/s away."""
    states = np.random.default_rng(1).uniform(-2.0, 2.0, (400, 2))
    values = [worlds.riccati(state, HORIZON)[0] for state in states]
    return learned_leaf(KEY, jnp.asarray(states), jnp.asarray(values))


@pytest.mark.slow
def test_values_of_other_states_are_those_of_riccati(leaf):
    states = np.random.default_rng(2).uniform(-1.5, 1.5, (100, 2))
    expected = np.array([worlds.riccati(state, HORIZON)[0] for state in states])
    found = jax.vmap(lambda state: leaf(None, state))(jnp.asarray(states))
    # A quadratic is smooth over a standard deviation: 1 % of the values' own spread.
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.01 * expected.std()


def test_a_plan_of_one_step_is_the_first_of_a_long_one(leaf):
    state = np.array([1.0, -0.5])
    value, accelerations = worlds.riccati(state, HORIZON + 1)
    listed = jnp.linspace(-3.0, 3.0, 25)[:, None]
    plan = random_shooting(
        KEY,
        certain(1.0),
        jnp.asarray(state),
        transition_fn=worlds.integrate,
        reward_fn=worlds.quadratic_reward,
        actions=listed,
        depth=1,
        leaf_fn=leaf,
        num_samples=400,
    )
    # The listed ones are 0.25 apart, and the learnt value is off by a hundredth or so.
    assert float(plan.action[0]) == pytest.approx(accelerations[0], abs=0.25)
    assert float(plan.value) == pytest.approx(value, rel=0.02)


def test_nothing_is_promised_beyond_what_was_seen(leaf):
    values = jax.vmap(lambda state: leaf(None, state))(100.0 * jnp.eye(2))
    assert jnp.all((values >= leaf.bounds[0]) & (values <= leaf.bounds[1]))


def pay_nothing(hypothesis, state, action, after):
    return jnp.zeros(())


def test_a_leaf_learnt_anew_shares_the_program():
    num_traces = 0

    def counted(key, hypothesis, state, action):
        nonlocal num_traces
        num_traces += 1
        return worlds.integrate(key, hypothesis, state, action)

    states = jnp.asarray(np.random.default_rng(3).normal(size=(20, 2)))

    def value(sign):
        return float(
            random_shooting(
                KEY,
                certain(1.0),
                jnp.zeros(2),
                transition_fn=counted,
                reward_fn=pay_nothing,
                actions=jnp.zeros((1, 1)),
                depth=1,
                leaf_fn=learned_leaf(KEY, states, jnp.full(20, sign), num_features=8),
                num_samples=1,
            ).value
        )

    assert value(1.0) == pytest.approx(1.0)
    num_first = num_traces
    assert num_first > 0
    assert value(-1.0) == pytest.approx(-1.0)
    assert num_traces == num_first


@pytest.mark.parametrize(
    ("values", "options", "message"),
    [
        (jnp.zeros(3), {}, "values: expected one number for each state"),
        (jnp.zeros(2), {"num_features": 0}, "num_features: expected a positive"),
        (jnp.zeros(2), {"length_scale": 0.0}, "length_scale: expected a number above"),
        (jnp.zeros(2), {"ridge": -1.0}, "ridge: expected a number above 0"),
    ],
)
def test_bad_input_is_refused(values, options, message):
    with pytest.raises(ValueError, match=message):
        learned_leaf(KEY, jnp.zeros((2, 2)), values, **options)
