"""Agents on a line of five places, whose best return is known, and on a cart."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.agents import (
    compile_episode,
    make_agent,
    random_agent,
    run_episode,
)
from boomdp_jax.envs import Cart
from boomdp_jax.models import (
    BodyRegression,
    LinearRegression,
    LocallyWeighted,
    TrueModel,
)
from tests.agents.line_world import LineWorld


def knowing(task, **options):
    params = task.default_params()
    model = TrueModel(params.physics, task.advance)
    return make_agent("true", task, model, params.goal, **options), params


def test_who_knows_the_line_walks_it_at_once():
    task = LineWorld()
    agent, params = knowing(task)
    record, _ = run_episode(jax.random.key(0), task, params, agent)
    np.testing.assert_array_equal(record.reward, [-3, -2, -1] + [0] * 7)
    np.testing.assert_array_equal(record.action, [1] * 4 + [-1] * 6)
    np.testing.assert_array_equal(record.state[:4, 0, 0], [1, 2, 3, 4])
    assert np.all(np.isnan(record.state[4:]))
    np.testing.assert_array_equal(record.model_error[:4], 0.0)
    assert record.num_done == 4


@pytest.mark.slow
def test_who_regresses_learns_the_line():
    """x' = x + u is linear, but for the ends."""
    task = LineWorld(num_steps=40)
    params = task.default_params()
    model = BodyRegression(task.spec.scene, LinearRegression(), frame="world")
    agent = make_agent("lr", task, model, params.goal, exploration=0.3)
    first, learnt = run_episode(jax.random.key(0), task, params, agent)
    greedy = make_agent("lr", task, model, params.goal)
    again, _ = run_episode(jax.random.key(1), task, params, greedy, learnt=learnt)
    assert first.num_done < 40
    np.testing.assert_array_equal(again.action[:4], 1)
    assert again.num_done == 4


@pytest.mark.slow
def test_what_is_never_tried_is_never_learnt():
    """Nothing is known, so all actions look alike; the first only meets the end."""
    task = LineWorld(num_steps=20)
    params = task.default_params()
    model = BodyRegression(task.spec.scene, LinearRegression(), frame="world")
    greedy = make_agent("lr", task, model, params.goal)
    record, _ = run_episode(jax.random.key(0), task, params, greedy)
    np.testing.assert_array_equal(record.action, 0)
    assert record.num_done == 20


@pytest.mark.slow
def test_who_tries_anything_has_a_drunkards_walk():
    """Its length is a chain's time to absorption, from the chain's own matrix."""
    task = LineWorld(num_steps=400)
    params = task.default_params()
    agent = random_agent(TrueModel(params.physics, task.advance))
    lengths = [
        run_episode(jax.random.key(seed), task, params, agent)[0].num_done
        for seed in range(60)
    ]
    stay = 0.5 * (np.eye(4, k=1) + np.eye(4, k=-1))
    stay[0, 0] = 0.5
    visits = np.linalg.inv(np.eye(4) - stay)
    mean = visits.sum(axis=1)
    variance = (2 * visits - np.eye(4)) @ mean - mean**2
    assert mean[0] == pytest.approx(20.0)
    # Four standard errors: a false alarm in 16,000.
    assert abs(np.mean(lengths) - mean[0]) < 4 * np.sqrt(variance[0] / 60)


@pytest.mark.parametrize("field", ["num_hypotheses", "capacity"])
def test_numbers_below_one_are_refused(field):
    with pytest.raises(ValueError, match=f"{field}: expected at least 1, got 0"):
        knowing(LineWorld(), **{field: 0})


def test_a_probability_is_one():
    with pytest.raises(ValueError, match=r"exploration: expected in \[0, 1\], got 2"):
        knowing(LineWorld(), exploration=2.0)


@pytest.mark.usefixtures("no_type_checks")
@pytest.mark.parametrize(
    ("noise", "got"),
    [
        (0.1, r"shape \(\)"),
        (jnp.full(3, 0.1), r"shape \(3,\)"),
        (jnp.array([0.5, 0.5, -0.5, 0.5]), r"\[0\.5, 0\.5, -0\.5, 0\.5\]"),
        (jnp.array([0.5, jnp.inf, 0.5, 0.5]), r"\[0\.5, inf, 0\.5, 0\.5\]"),
    ],
)
@pytest.mark.parametrize("way", [run_episode, compile_episode])
def test_reading_noise_is_four_finite_numbers(way, noise, got):
    task = LineWorld()
    agent, params = knowing(task)
    key = [jax.random.key(0)] if way is run_episode else []
    message = f"^reading_noise: expected four finite numbers, at least 0, got {got}$"
    with pytest.raises(ValueError, match=message):
        way(*key, task, params, agent, reading_noise=noise)


@pytest.fixture(scope="module")
def ride():
    task = Cart(num_steps=12)
    agent, params = knowing(task, capacity=2)
    return task, agent, params, run_episode(jax.random.key(3), task, params, agent)[0]


@pytest.mark.slow
def test_a_record_is_what_the_task_says_of_its_actions(ride):
    task, _, params, record = ride
    start_key = jax.random.split(jax.random.key(3), 4)[0]
    _, state = task.reset(start_key, params)
    for step in range(record.num_done):
        _, state, reward, _, _ = task.step(
            None, state, int(record.action[step]), params
        )
        np.testing.assert_allclose(record.state[step], state.physics.array, atol=1e-12)
        np.testing.assert_allclose(record.reward[step], reward, atol=1e-12)
    # A decision is carried out for as many steps as the plan holds it.
    held = record.action[: record.num_done]
    np.testing.assert_array_equal(held[0::2][: len(held[1::2])], held[1::2])
    assert np.all(record.plan_seconds[0 : record.num_done : 2] > 0)
    assert np.all(record.plan_seconds[1 : record.num_done : 2] == 0)


@pytest.mark.slow
def test_who_does_not_learn_is_unhurt_by_noise(ride):
    task, agent, params, record = ride
    noisy, _ = run_episode(
        jax.random.key(3), task, params, agent, reading_noise=jnp.full(4, 0.3)
    )
    np.testing.assert_array_equal(noisy.reward, record.reward)
    np.testing.assert_array_equal(noisy.action, record.action)


@pytest.mark.slow
def test_readings_have_the_noise_that_was_asked_for():
    """A table of what was learnt from, against what was."""
    task = LineWorld(num_steps=400)
    params = task.default_params()
    model = BodyRegression(task.spec.scene, LocallyWeighted(capacity=400))
    agent = random_agent(model)
    scale = jnp.array([0.1, 0.2, 0.3, 0.4])
    record, learnt = run_episode(
        jax.random.key(0), task, params, agent, reading_noise=scale
    )
    spin = np.asarray(learnt.table.inputs)[0, : record.num_done, 2]
    assert abs(spin.std() / 0.4 - 1) < 4 / np.sqrt(2 * record.num_done)
