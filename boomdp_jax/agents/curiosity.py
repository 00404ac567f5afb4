"""Pushes that tell most, for as long as it is open which constraints there are.

An agent that plans by draws of its posterior tries what some of them promise, and so
learns by the way. A curious one begins with the push of the greatest expected
information (`inference.informative_wrench`), until one structure is all but certain or
it has learnt from so many steps. Reading a posterior off the particles and comparing
draws costs 0.1 to 0.3 s a decision on two cores, which is why it ends there.
"""

from typing import Any

import numpy as np

from boomdp_jax.agents.agent import ExploreFn
from boomdp_jax.core.arrays import IntScalar, Key
from boomdp_jax.envs.environment import AbstractEnvironment
from boomdp_jax.envs.living_room import LivingRoom
from boomdp_jax.inference.pushes.informative_wrench import informative_wrench
from boomdp_jax.models.per_body import PerBody, PerBodyLearnt
from boomdp_jax.models.physics_model import PhysicsLearnt, PhysicsModel
from boomdp_jax.physics.state import State

DECIDED = 0.95
"""Probability of a structure at which it is no longer open."""
MOST_ROWS = 8
"""Steps learnt from, after which nothing is asked any more."""
_NUM_DRAWS = 64


def curious(task: AbstractEnvironment, model: PhysicsModel) -> ExploreFn:
    """Ask what would tell most of the one scene that there is.

    Args:
        task: whose actions are candidates, each held as long as a decision is.
        model: what is learnt.

    Returns:
        A function for `Agent.explore`.
    """

    def explore(
        key: Key, learnt: PhysicsLearnt, state: State, planned: IntScalar
    ) -> int | None:
        del planned
        wrenches = np.asarray(task.actions.wrench)
        return _best(key, model, learnt, state, wrenches, task.hints.action_repeat)

    return explore


def curious_of_pieces(task: LivingRoom, model: PerBody) -> ExploreFn:
    """Ask what would tell most of the piece that is to be moved next.

    Args:
        task: the room.
        model: one `PhysicsModel` for each piece.

    Returns:
        A function for `Agent.explore`.
    """
    wrenches = np.asarray(task.piece_actions)[:, :-1, None]

    def explore(
        key: Key, learnt: PerBodyLearnt, state: State, planned: IntScalar
    ) -> int | None:
        body = int(planned) // wrenches.shape[1]
        if body >= len(wrenches):
            return None  # Nothing is to be moved.
        own: Any = model.models[body]
        lone = State(state.pose[body][None], state.twist[body][None])
        best = _best(
            key, own, learnt.parts[body], lone, wrenches[body], task.hints.action_repeat
        )
        return None if best is None else body * wrenches.shape[1] + best

    return explore


def _best(
    key: Key,
    model: PhysicsModel,
    learnt: PhysicsLearnt,
    state: State,
    wrenches: np.ndarray,
    num_steps: int,
) -> int | None:
    """Which of the wrenches tells most; None where that is no longer the question."""
    online, belief = model.online, learnt.belief
    if learnt.num_rows >= MOST_ROWS or online.structure_share(belief) >= DECIDED:
        return None
    told = informative_wrench(
        key,
        online.posterior(belief, check=False),
        state,
        wrenches,
        num_steps=num_steps,
        num_draws=_NUM_DRAWS,
    )
    return told.best
