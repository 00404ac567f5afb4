"""Who was stopped and learnt nothing tries anything; who moves or learns does not."""

import jax
import jax.numpy as jnp
import pytest

from boomdp_jax.agents import restless
from boomdp_jax.envs import Cart
from boomdp_jax.models.physics_model import PhysicsLearnt
from boomdp_jax.physics import State

REST = State(jnp.zeros((1, 3)), jnp.zeros((1, 3)))
MOVING = State(jnp.zeros((1, 3)), jnp.array([[0.0, 0.1, 0.0]]))
STOPPED = PhysicsLearnt(None, 3, True)
NUM = 400


@pytest.fixture(scope="module")
def tried():
    """What is tried in so many decisions, by case."""
    task = Cart()
    explore = restless(task)
    keys = jax.random.split(jax.random.key(0), NUM)
    cases = {
        "stopped": (STOPPED, REST),
        "moving": (STOPPED, MOVING),
        "learnt": (STOPPED._replace(is_broken=False), REST),
        "new": (STOPPED._replace(num_rows=0), REST),
    }
    return task, {
        name: [explore(key, *case, jnp.asarray(0)) for key in keys[: NUM // 8]]
        if name != "stopped"
        else [explore(key, *case, jnp.asarray(0)) for key in keys]
        for name, case in cases.items()
    }


@pytest.mark.parametrize("case", ["moving", "learnt", "new"])
def test_who_is_not_stuck_does_as_planned(tried, case):
    assert set(tried[1][case]) == {None}


def test_who_is_stuck_tries_every_action_alike_half_of_the_time(tried):
    task, found = tried[0], tried[1]["stopped"]
    tries = [index for index in found if index is not None]
    # Four standard errors: a false alarm in 16,000.
    assert abs(len(tries) - NUM / 2) < 4 * (NUM / 4) ** 0.5
    counts = [tries.count(index) for index in range(task.num_actions)]
    share = len(tries) / task.num_actions
    assert all(abs(count - share) < 4 * share**0.5 for count in counts)
    assert sum(counts) == len(tries)


def test_the_physics_may_be_a_part_of_what_was_learnt():
    explore = restless(Cart(), lambda learnt: learnt["physics"])
    learnt = {"physics": STOPPED._replace(num_rows=0)}
    assert explore(jax.random.key(0), learnt, REST, jnp.asarray(0)) is None
