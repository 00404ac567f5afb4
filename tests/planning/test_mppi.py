"""Path integral control: closed forms of its mean, and a double integrator."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.planning import certain, mppi
from tests.planning import small_worlds as worlds

START = np.array([1.0, -0.5])
WIDE = jnp.array([[-10.0, -10.0], [10.0, 10.0]])


def stay(key, hypothesis, state, action):
    del key, hypothesis, action
    return state, False


def pay_by_slope(hypothesis, state, action, next_state):
    """The hypothesis is what each number of an action pays."""
    del state, next_state
    return hypothesis @ action


def tilted(slope, seed=0, **options):
    return mppi(
        jax.random.key(seed),
        certain(jnp.asarray(slope)),
        0.0,
        **{
            "transition_fn": stay,
            "reward_fn": pay_by_slope,
            "actions": WIDE,
            "depth": 2,
            "num_samples": 20_000,
            "noise_scale": 0.05,
            "temperature": 0.5,
            "relative": False,
        }
        | options,
    )


def test_gaussian_draws_tilt_by_the_slope_over_the_temperature():
    # Exponential weights of a linear return shift a Gaussian's mean by σ² c / λ; here
    # σ = 0.05 · 10 and λ = 0.5. The mean of 20,000 draws of weights whose effective
    # share is exp(−σ² |c|² / λ²), a quarter here for two levels, has a standard error
    # of 0.5 / √5000 = 0.007 in each of four numbers; five of them.
    slope = np.array([0.6, -0.6])
    plan = tilted(slope)
    np.testing.assert_allclose(
        plan.sequence, np.tile(0.25 * slope / 0.5, (2, 1)), atol=0.035
    )
    assert plan.value == pytest.approx(float((plan.sequence @ slope).sum()))


def test_every_iteration_tilts_further():
    slope = np.array([0.6, -0.6])
    plan = tilted(slope, num_iterations=3)
    np.testing.assert_allclose(
        plan.sequence, np.tile(3 * 0.25 * slope / 0.5, (2, 1)), atol=0.07
    )


def test_scale_of_rewards_is_nothing_to_a_relative_temperature():
    options = {"relative": True, "num_samples": 256}
    one, thousand = (
        tilted(np.array([1.0, 2.0]) * scale, **options) for scale in (1.0, 1000.0)
    )
    np.testing.assert_allclose(one.sequence, thousand.sequence, rtol=1e-9)
    absolute = {"relative": False, "num_samples": 256}
    one, thousand = (
        tilted(np.array([1.0, 2.0]) * scale, **absolute) for scale in (1.0, 1000.0)
    )
    assert not np.allclose(one.sequence, thousand.sequence, rtol=0.1)


def test_great_heat_averages_and_great_cold_picks():
    slope, options = np.array([1.0, 0.0]), {"num_samples": 256}
    hot = tilted(slope, temperature=1e6, **options)
    cold = tilted(slope, temperature=1e-6, **options)
    # A mean of 256 draws of σ = 0.5 in 4 numbers; five standard errors.
    np.testing.assert_allclose(hot.sequence, np.zeros((2, 2)), atol=5 * 0.5 / 16)
    # The best of 256 sums of two such numbers is above 1 unless all stay below 1.4
    # standard deviations: 0.92²⁵⁶.
    assert cold.value > 1.0


def test_double_integrator_is_steered_nearly_as_riccati_says():
    plan = mppi(
        jax.random.key(0),
        certain(1.0),
        jnp.asarray(START),
        transition_fn=worlds.integrate,
        reward_fn=worlds.quadratic_reward,
        leaf_fn=worlds.quadratic_leaf,
        actions=worlds.ACCELERATIONS,
        depth=5,
        num_samples=500,
        num_iterations=15,
        noise_scale=0.2,
    )
    value, actions = worlds.riccati(START, 5)
    assert value * 1.02 < plan.value <= value + 1e-12
    assert plan.action[0] == pytest.approx(actions[0], abs=0.3)


def test_actions_stay_in_the_box():
    plan = tilted(np.array([5.0, -5.0]), noise_scale=3.0, temperature=1e-3)
    np.testing.assert_allclose(plan.sequence, np.tile([10.0, -10.0], (2, 1)))


def test_returns_that_are_not_numbers_leave_the_start_as_it_is():
    first = tilted(np.array([0.6, -0.6]), num_samples=256)
    plan = tilted(np.array([1.0, np.nan]), num_samples=256, previous=first)
    expected = jnp.concatenate([first.sequence[1:], first.sequence[-1:]])
    np.testing.assert_allclose(plan.sequence, expected, atol=1e-12)
    assert plan.value == -np.inf


def pay_left_of_zero(hypothesis, state, action, next_state):
    del hypothesis, state, next_state
    return jnp.where(action[0] < 0, action[1], jnp.nan)


def test_draws_that_are_not_numbers_are_left_out():
    plan = tilted(
        np.zeros(2), reward_fn=pay_left_of_zero, depth=1, relative=True, num_samples=512
    )
    # The mean of what is left: of half a Gaussian, −σ √(2/π) = −0.40.
    assert plan.action[0] == pytest.approx(-0.40, abs=0.25)
    assert plan.action[1] > 0.2


def test_previous_plan_is_where_the_search_starts():
    first = tilted(np.array([0.6, -0.6]), num_samples=256)
    again = tilted(np.zeros(2), num_samples=1, previous=first)
    expected = jnp.concatenate([first.sequence[1:], first.sequence[-1:]])
    np.testing.assert_allclose(again.sequence, expected, atol=1e-12)


@pytest.mark.parametrize("option", ["temperature", "noise_scale"])
def test_numbers_that_are_not_positive_are_refused(option):
    with pytest.raises(ValueError, match=f"{option}: expected a number above 0"):
        tilted(np.zeros(2), **{option: 0.0})
