"""Curious while it is open what a thing is, and no longer."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

from boomdp_jax.agents import Agent, curious
from boomdp_jax.agents.curiosity import MOST_ROWS
from boomdp_jax.envs import Cart
from boomdp_jax.inference import OnlineBelief
from boomdp_jax.models import PhysicsModel, TrueModel
from boomdp_jax.planning.belief import certain
from boomdp_jax.planning.plan import plan_of
from tests.agents.line_world import LineWorld


@pytest.mark.slow
def test_the_push_that_tells_most_is_asked_for_while_it_is_open():
    task = Cart()
    model = PhysicsModel(
        OnlineBelief(task.spec, capacity=16, num_particles=64), task.advance
    )
    explore = curious(task, model)
    learnt = model.init(jax.random.key(0))
    state = task.start(jax.random.key(1), task.default_params())
    planned = jnp.asarray(0)
    told = explore(jax.random.key(2), learnt, state, planned)
    assert told in range(task.num_actions)
    enough = learnt._replace(num_rows=MOST_ROWS)
    assert explore(jax.random.key(2), enough, state, planned) is None


@pytest.mark.parametrize("told", [None, 0])
def test_what_is_asked_for_is_done_instead_of_the_plan(told):
    task = LineWorld()
    asked = []

    def explore(key, learnt, state, planned):
        asked.append((learnt, int(planned)))
        return told

    planned = eqx.tree_at(
        lambda plan: plan.index, plan_of(jnp.ones((3, 1, 3))), jnp.asarray(1)
    )
    agent = Agent(
        name="any",
        model=TrueModel(task.default_params().physics, task.advance),
        plan=lambda *_: planned,
        num_hypotheses=1,
        num_held=1,
        explore=explore,
    )
    state = task.start(None, task.default_params())
    index, plan = agent.decide(
        jax.random.key(0), certain(jnp.zeros(1)), state, None, 2, learnt="all"
    )
    assert asked == [("all", 1)]
    assert int(index) == (1 if told is None else told)
    assert (plan is None) == (told is not None)
