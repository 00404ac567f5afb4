"""The model of one who knows: what every learner is measured against."""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float, PyTree

from boomdp_jax.core.arrays import BoolScalar, Key
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.state import State
from boomdp_jax.planning.belief import Belief, certain

Advance = Callable[[Params, State, Float[Array, "body 3"]], State]
"""One step of a world under a hypothesis, such as an environment's `advance`."""


class TrueModel(AbstractModel):
    """Knows Φ, and learns nothing."""

    physics: Params
    advance: Advance = eqx.field(static=True)
    is_compiled: ClassVar[bool] = True

    def init(self, key: Key) -> PyTree:
        """Φ itself."""
        del key
        return self.physics

    def update(
        self,
        learnt: PyTree,
        state: State,
        wrench: Float[Array, "body 3"],
        next_state: State,
        *,
        starts_episode: BoolScalar | bool = False,
    ) -> PyTree:
        """There is nothing to add."""
        del state, wrench, next_state, starts_episode
        return learnt

    def sample(self, key: Key, learnt: PyTree, num_hypotheses: int) -> Belief:
        """The one hypothesis."""
        del key, num_hypotheses
        return certain(learnt)

    def transition(
        self,
        key: Key,
        hypothesis: PyTree,
        state: State,
        wrench: Float[Array, "body 3"],
    ) -> State:
        """A step of the world itself."""
        del key
        return self.advance(hypothesis, state, wrench)
