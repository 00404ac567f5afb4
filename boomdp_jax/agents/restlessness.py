"""Another push, where the planned one was stopped before and taught nothing.

Who is stopped by a wall learns nothing of itself, and who is sure of the wrong thing,
or reads its place a little wrong, may prefer to stand there: a cart that took itself to
be pinned, after one push, leant against a wall for a thousand steps. A push that moves
it tells what it is. So what has been tried since it last moved freely is not tried
again before everything else.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from boomdp_jax.agents.agent import ExploreFn
from boomdp_jax.core.arrays import IntScalar, Key
from boomdp_jax.envs.environment import AbstractEnvironment
from boomdp_jax.models.physics_model import PhysicsLearnt
from boomdp_jax.physics.state import State

_AT_REST = 1e-6
"""Rates below which nothing moves [m/s, rad/s]."""


def restless(
    task: AbstractEnvironment, physics_of: Callable[[Any], PhysicsLearnt] | None = None
) -> ExploreFn:
    """Whether to try something else than what is planned.

    Args:
        task: what is to be done.
        physics_of: what the physics has come to, of all that was learnt; default: that
            is all.

    Returns:
        What `make_agent` takes as `explore`.
    """
    wrenches = np.asarray(task.actions.wrench, float)

    def explore(
        key: Key, learnt: PyTree, state: State, planned: IntScalar
    ) -> int | None:
        physics = learnt if physics_of is None else physics_of(learnt)
        is_new = physics.num_rows == 0
        is_moving = float(np.max(np.abs(np.asarray(state.twist)))) > _AT_REST
        if is_new or is_moving or not physics.is_broken:
            return None
        is_tried = np.zeros(len(wrenches), bool)
        for wrench in physics.stopped:
            off = np.abs(wrenches - wrench[None]).max(axis=(1, 2))
            is_tried[np.argmin(off)] = True
        if not is_tried[int(planned)]:
            return None
        left = (
            np.flatnonzero(~is_tried)
            if not is_tried.all()
            else np.arange(task.num_actions)
        )
        return int(left[int(jax.random.randint(key, (), 0, len(left)))])

    return explore
