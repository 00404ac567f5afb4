"""An episode as one program is the episode of the loop, action by action."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.agents import (
    can_compile,
    compile_episode,
    make_agent,
    random_agent,
    run_episode,
)
from boomdp_jax.envs import Cart
from boomdp_jax.experiments import agent_of
from boomdp_jax.models import BodyRegression, LinearRegression, TrueModel
from tests.agents.line_world import LineWorld

FIELDS = ("reward", "action", "state", "model_error")


def regressing(task, exploration):
    params = task.default_params()
    model = BodyRegression(task.spec.scene, LinearRegression(), frame="world")
    return make_agent("lr", task, model, params.goal, exploration=exploration), params


def check_same(task, params, agent, seeds, noise=None):
    """Of both ways, what happened and what was learnt; returns the records."""
    compiled = compile_episode(task, params, agent, reading_noise=noise)
    records = []
    for seed in seeds:
        key = jax.random.key(seed)
        loop, learnt = run_episode(key, task, params, agent, reading_noise=noise)
        whole, also_learnt = compiled(key)
        np.testing.assert_array_equal(whole.action, loop.action)
        for field in FIELDS:
            np.testing.assert_allclose(
                getattr(whole, field), getattr(loop, field), atol=1e-9, err_msg=field
            )
        for a, b in zip(
            jax.tree.leaves(also_learnt), jax.tree.leaves(learnt), strict=True
        ):
            np.testing.assert_allclose(a, b, atol=1e-9)
        np.testing.assert_array_equal(whole.plan_seconds > 0, loop.plan_seconds > 0)
        records.append(whole)
    return records


@pytest.mark.slow
def test_both_give_the_same_episode_of_a_learner():
    task = LineWorld(num_steps=30)
    agent, params = regressing(task, exploration=0.3)
    records = check_same(task, params, agent, range(4), jnp.full(4, 0.05))
    # One came to the end before its time, so that both ends were compared.
    assert min(record.num_done for record in records) < task.num_steps


@pytest.mark.slow
def test_both_give_the_same_episode_of_chance():
    task = LineWorld(num_steps=10)
    params = task.default_params()
    agent = random_agent(TrueModel(params.physics, task.advance), num_held=3)
    for record in check_same(task, params, agent, range(2)):
        # The time of the whole is shared out evenly.
        shares = record.plan_seconds[record.plan_seconds > 0]
        np.testing.assert_array_equal(shares, shares[0])
        assert np.all(np.isnan(record.learn_seconds[: record.num_done]))
        assert np.all(record.learn_seconds[record.num_done :] == 0)


def test_who_learns_on_the_host_is_refused():
    task = Cart(num_steps=2)
    agent = agent_of("physics", task, task.default_params())
    assert not can_compile(agent)
    with pytest.raises(ValueError, match=r"agent: expected one whose model is comp"):
        compile_episode(task, task.default_params(), agent)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["true", "oo-lwr"])
def test_both_give_the_same_ride_of_a_cart(name):
    task = Cart(num_steps=13)
    params = task.default_params()
    check_same(task, params, agent_of(name, task, params), [3])
