"""A model that was taught beforehand, and learns nothing while it acts."""

from typing import Any, ClassVar

from jaxtyping import Array, Float, PyTree

from boomdp_jax.core.arrays import BoolScalar, Key
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.physics.state import State
from boomdp_jax.planning.belief import Belief, resample


class FixedBelief(AbstractModel):
    """A belief that stays as it is, and the law that its hypotheses are of."""

    belief: Belief
    law: Any
    """Anything with `transition`, such as the model that was taught."""
    is_compiled: ClassVar[bool] = True

    def init(self, key: Key) -> Belief:
        """What was taught."""
        del key
        return self.belief

    def update(
        self,
        learnt: Belief,
        state: State,
        wrench: Float[Array, "body 3"],
        next_state: State,
        *,
        starts_episode: BoolScalar | bool = False,
    ) -> Belief:
        """Nothing is added."""
        del state, wrench, next_state, starts_episode
        return learnt

    def sample(self, key: Key, learnt: Belief, num_hypotheses: int) -> Belief:
        """So many of the hypotheses, or all if they are no more."""
        return resample(key, learnt, num_hypotheses)

    def transition(
        self,
        key: Key,
        hypothesis: PyTree,
        state: State,
        wrench: Float[Array, "body 3"],
    ) -> State:
        """As the law has it."""
        return self.law.transition(key, hypothesis, state, wrench)
