"""What a transition model is that an agent learns while it acts."""

import abc

import equinox as eqx
from jaxtyping import Array, Float, PyTree

from boomdp_jax.core.arrays import BoolScalar, Key
from boomdp_jax.physics.state import State
from boomdp_jax.planning.belief import Belief


class AbstractModel(eqx.Module):
    """How the bodies of one scene move, as far as is known: init, update, sample.

    What has been learnt is a pytree of fixed shapes; `sample` turns it into a belief
    for a planner, and `transition` says what one hypothesis of it expects. A model
    whose `is_compiled` is true has pure functions throughout, so that a whole episode
    can be one scan; another one's `update` runs on the host.
    """

    is_compiled: eqx.AbstractClassVar[bool]

    @abc.abstractmethod
    def init(self, key: Key) -> PyTree:
        """What is known before anything was seen.

        Args:
            key: random key; all later chance follows from it and the transitions.

        Returns:
            What has been learnt: nothing yet.
        """

    @abc.abstractmethod
    def update(
        self,
        learnt: PyTree,
        state: State,
        wrench: Float[Array, "body 3"],
        next_state: State,
        *,
        starts_episode: BoolScalar | bool = False,
    ) -> PyTree:
        """Take one transition in.

        Args:
            learnt: so far.
            state: reading before the step; NaN marks what is missing.
            wrench: at the centres of mass, held over the scene's time step [N, N, N m].
            next_state: reading after it.
            starts_episode: whether bodies were moved otherwise since the last one.

        Returns:
            What has been learnt now.
        """

    @abc.abstractmethod
    def sample(self, key: Key, learnt: PyTree, num_hypotheses: int) -> Belief:
        """Hypotheses for a planner, at most so many, with weights."""

    @abc.abstractmethod
    def transition(
        self,
        key: Key,
        hypothesis: PyTree,
        state: State,
        wrench: Float[Array, "body 3"],
    ) -> State:
        """What one hypothesis expects after one time step; pure, for `jit` and `vmap`.

        Args:
            key: for models that are random in themselves.
            hypothesis: one of `sample`'s, without its leading axis.
            state: of all bodies.
            wrench: held over the step [N, N, N m].

        Returns:
            The next state.
        """
