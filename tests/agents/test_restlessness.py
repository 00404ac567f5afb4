"""Who was stopped and learnt nothing tries something else; others do as planned."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.agents import restless
from boomdp_jax.envs import Cart
from boomdp_jax.models.physics_model import PhysicsLearnt
from boomdp_jax.physics import State

REST = State(jnp.zeros((1, 3)), jnp.zeros((1, 3)))
MOVING = State(jnp.zeros((1, 3)), jnp.array([[0.0, 0.1, 0.0]]))
TASK = Cart()
WRENCHES = np.asarray(TASK.actions.wrench, float)
PLANNED = 2


def after(*actions: int) -> PhysicsLearnt:
    """Who has learnt from three rows, and was stopped with these actions since."""
    return PhysicsLearnt(None, 3, True, tuple(WRENCHES[index] for index in actions))


def tries(learnt, state=REST, num=400):
    explore = restless(TASK)
    keys = jax.random.split(jax.random.key(0), num)
    return [explore(key, learnt, state, jnp.asarray(PLANNED)) for key in keys]


@pytest.mark.parametrize(
    ("learnt", "state"),
    [
        (after(PLANNED), MOVING),
        (after(PLANNED)._replace(is_broken=False), REST),
        (after(PLANNED)._replace(num_rows=0), REST),
        # At a wall, but not by this push.
        (after(0, 5), REST),
        (after(), REST),
    ],
)
def test_who_is_not_stuck_does_as_planned(learnt, state):
    assert set(tries(learnt, state, num=20)) == {None}


def test_what_was_stopped_is_not_tried_again_before_everything_else():
    found = tries(after(PLANNED, PLANNED, 5))
    left = sorted(set(range(TASK.num_actions)) - {PLANNED, 5})
    counts = np.array([found.count(index) for index in left])
    assert counts.sum() == len(found)
    # Four standard errors of a share of one sixth: a false alarm in 3,000.
    share = len(found) / len(left)
    assert np.all(np.abs(counts - share) < 4 * share**0.5)


def test_where_everything_was_tried_anything_is_tried_again():
    found = tries(after(*range(TASK.num_actions)))
    assert set(found) == set(range(TASK.num_actions))


def test_the_physics_may_be_a_part_of_what_was_learnt():
    explore = restless(TASK, lambda learnt: learnt["physics"])
    learnt = {"physics": after(PLANNED)}
    tried = explore(jax.random.key(0), learnt, REST, jnp.asarray(PLANNED))
    assert tried not in (None, PLANNED)
    assert explore(jax.random.key(0), learnt, REST, jnp.asarray(0)) is None
