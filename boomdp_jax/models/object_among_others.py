"""Object-oriented regression of one body of a room, told what is next to it.

As `ObjectOriented`, for those who keep a model and a tree for each body (`PerBody`):
which body it is, is data, so that models of all bodies stack and share one program.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from boomdp_jax.core.arrays import BoolScalar, IntScalar, Key
from boomdp_jax.models.features import BodyFeatures
from boomdp_jax.models.locally_weighted import (
    LocalFit,
    LocallyWeighted,
    LocalRows,
    local_rows,
)
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.models.outline_contact import condition_number, touched_sectors
from boomdp_jax.models.regression import add_and_tune, fit_to_nothing
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State
from boomdp_jax.planning.belief import Belief, certain


class ObjectAmongOthers(AbstractModel):
    """A locally weighted law of one body for each set of its sides that is touched.

    States are those of the whole room; what is predicted of other bodies is that they
    stay.
    """

    scene: Scene
    body: Int[Array, ""]
    features: BodyFeatures
    regressor: LocallyWeighted
    radius: Float[Array, ""]
    """How near something has to be to touch [m]."""
    num_sectors: int = eqx.field(static=True, default=4)
    num_rays: int = eqx.field(static=True, default=10)
    is_compiled: ClassVar[bool] = True

    def init(self, key: Key) -> LocalFit:
        """A fit to nothing."""
        return fit_to_nothing(key, self.features, self.regressor)

    def update(
        self,
        learnt: LocalFit,
        state: State,
        wrench: Float[Array, "body 3"],
        next_state: State,
        *,
        starts_episode: BoolScalar | bool = False,
    ) -> LocalFit:
        """Take one transition of the room in, under the body's condition before it."""
        del starts_episode  # Rows stand for themselves.
        row = self.features.row(
            self._own(state), wrench[self.body][None], self._own(next_state)
        )
        condition = self._condition(state)[None]
        return add_and_tune(self.regressor, learnt, *row, condition)

    def sample(self, key: Key, learnt: LocalFit, num_hypotheses: int) -> Belief:
        """The one hypothesis."""
        del key, num_hypotheses
        return certain(jax.vmap(local_rows)(learnt))

    def transition(
        self,
        key: Key,
        hypothesis: LocalRows,
        state: State,
        wrench: Float[Array, "body 3"],
    ) -> State:
        """Of the room: the body as expected, the others where they are."""
        own = self.transition_among(
            key, hypothesis, self._own(state), wrench[self.body][None], state.pose
        )
        return State(
            state.pose.at[self.body].set(own.pose[0]),
            state.twist.at[self.body].set(own.twist[0]),
        )

    def transition_among(
        self,
        key: Key,
        hypothesis: LocalRows,
        state: State,
        wrench: Float[Array, "1 3"],
        room: Float[Array, "body 3"],
    ) -> State:
        """Of the body alone, while the others stay.

        Args:
            key: not needed.
            hypothesis: what was learnt of it.
            state: of the body.
            wrench: on the body [N, N, N m].
            room: poses of all bodies; where it has the body itself does not matter.

        Returns:
            The next state of the body.
        """
        pose = room.at[self.body].set(state.pose[0])
        condition = self._condition(State(pose, jnp.zeros_like(pose)))
        keys = jax.random.split(key, 1)
        outputs = jax.vmap(self.regressor.predict)(
            keys, hypothesis, self.features.inputs(state, wrench), condition[None]
        )
        return self.features.next_state(state, outputs)

    def _own(self, state: State) -> State:
        return State(state.pose[self.body][None], state.twist[self.body][None])

    def _condition(self, state: State) -> IntScalar:
        sectors = touched_sectors(
            self.scene,
            state,
            self.body,
            radius=self.radius,
            num_sectors=self.num_sectors,
            num_rays=self.num_rays,
        )
        return condition_number(sectors)
