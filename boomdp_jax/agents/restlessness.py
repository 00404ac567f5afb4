"""Any other push, where the last one was stopped and taught nothing.

Who is stopped by a wall learns nothing of itself, and who is sure of the wrong thing
may prefer to stand there: a cart that took itself to be pinned, after one push, leant
against a wall for a thousand steps. A push that moves it tells what it is.
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
_PROBABILITY = 0.5
"""Of doing anything; the plan may be right to begin at a wall."""


def restless(
    task: AbstractEnvironment, physics_of: Callable[[Any], PhysicsLearnt] | None = None
) -> ExploreFn:
    """Whether to try anything instead of what is planned.

    Args:
        task: what is to be done.
        physics_of: what the physics has come to, of all that was learnt; default: that
            is all.

    Returns:
        What `make_agent` takes as `explore`.
    """

    def explore(
        key: Key, learnt: PyTree, state: State, planned: IntScalar
    ) -> int | None:
        del planned
        physics = learnt if physics_of is None else physics_of(learnt)
        is_new = physics.num_rows == 0
        is_moving = float(np.max(np.abs(np.asarray(state.twist)))) > _AT_REST
        if is_new or is_moving or not physics.is_broken:
            return None
        try_key, any_key = jax.random.split(key)
        if not bool(jax.random.bernoulli(try_key, _PROBABILITY)):
            return None
        return int(jax.random.randint(any_key, (), 0, task.num_actions))

    return explore
