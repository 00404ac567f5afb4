"""A posterior over physics that is learnt online: the paper's own model.

Every transition goes into an `OnlineBelief`: which constraints exist, and all numbers.
Steps in which a body may have touched something tell nothing of its own numbers and are
left out; the next one begins an episode of the filter.
"""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from boomdp_jax.core.arrays import BoolScalar, Key
from boomdp_jax.inference.online.belief import OnlineBelief
from boomdp_jax.inference.online.state import BeliefState
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.models.true_model import Advance
from boomdp_jax.physics.state import State
from boomdp_jax.planning.belief import Belief, certain

MovedFreely = Callable[[State, State], Bool[Array, " body"]]
"""Whether bodies touched nothing in a step, as an observer can tell."""

_FIRST_REFITS = (1, 2, 4)
"""Rows after which the belief is fitted anew, whether it asks for that or not: prior
particles are too few for what a single push tells, and a planner waits for it."""


_MOST_STOPPED = 64
"""Steps that were left out whose wrenches are remembered."""


class PhysicsLearnt(NamedTuple):
    """What the physics has come to, on the host."""

    belief: BeliefState
    num_rows: int
    """Taken in so far."""
    is_broken: bool
    """Whether steps were left out since the last row."""
    stopped: tuple[np.ndarray, ...] = ()
    """Wrenches of those steps, `[body, 3]` each, latest last."""


class PhysicsModel(AbstractModel):
    """Online inference of structure and numbers; hypotheses are posterior draws."""

    online: OnlineBelief = eqx.field(static=True)
    advance: Advance = eqx.field(static=True)
    moved_freely: MovedFreely = eqx.field(static=True)
    is_point: bool = eqx.field(static=True)
    is_compiled: ClassVar[bool] = False

    def __init__(
        self,
        online: OnlineBelief,
        advance: Advance,
        moved_freely: MovedFreely | None = None,
        *,
        is_point: bool = False,
    ):
        """Set up.

        Args:
            online: the scene, and how its belief is kept.
            advance: a step of the world under a hypothesis.
            moved_freely: which bodies touched nothing in a step; default: all.
            is_point: whether `sample` gives the most probable hypothesis alone.
        """
        self.online = online
        self.advance = advance
        self.moved_freely = jax.jit(moved_freely or _always_free)
        self.is_point = is_point

    def init(self, key: Key) -> PhysicsLearnt:
        """The prior."""
        return PhysicsLearnt(self.online.init(key), 0, True)

    def update(
        self,
        learnt: PhysicsLearnt,
        state: State,
        wrench: Float[Array, "body 3"],
        next_state: State,
        *,
        starts_episode: BoolScalar | bool = False,
    ) -> PhysicsLearnt:
        """Take one transition in, and fit anew where the belief asks for it."""
        if not bool(jnp.all(self.moved_freely(state, next_state))):
            stopped = (*learnt.stopped, np.asarray(wrench, float))
            return learnt._replace(is_broken=True, stopped=stopped[-_MOST_STOPPED:])
        belief, info = self.online.step(
            learnt.belief,
            state,
            wrench,
            next_state,
            starts_episode=learnt.is_broken or bool(starts_episode),
        )
        num_rows = learnt.num_rows + 1
        if num_rows in _FIRST_REFITS or bool(info.needs_refit):
            belief, _ = self.online.refit(belief)
        return PhysicsLearnt(belief, num_rows, False)

    def sample(self, key: Key, learnt: PyTree, num_hypotheses: int) -> Belief:
        """Draws of the posterior, of equal weight; or the most probable one."""
        if self.is_point:
            return certain(self.online.best_params(learnt.belief))
        params = self.online.sample_params(key, learnt.belief, num_hypotheses)
        return Belief(params, jnp.zeros(num_hypotheses))

    def transition(
        self,
        key: Key,
        hypothesis: Any,
        state: State,
        wrench: Float[Array, "body 3"],
    ) -> State:
        """A step of the world under a draw."""
        del key
        return self.advance(hypothesis, state, wrench)


def _always_free(state: State, next_state: State) -> Bool[Array, " body"]:
    del next_state
    return jnp.ones(state.pose.shape[0], bool)
