"""Object-oriented regression: each body has a locally weighted law per contact.

A condition is the set of a body's sides that are next to something (`outline_contact`).
Bodies still know nothing of each other but for the condition, and it is the condition
before the step that counts: what a push into a wall does is learnt once there are rows
of this side against something, wherever that was.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from boomdp_jax.core.arrays import BoolScalar, Key
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
from boomdp_jax.models.table import check_at_least
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State
from boomdp_jax.planning.belief import Belief, certain


def among(state: State, surroundings: Float[Array, "other 3"]) -> State:
    """A state with bodies at rest behind its own.

    Args:
        state: of some bodies.
        surroundings: poses of the others.
    """
    others = surroundings.astype(state.pose.dtype)
    return State(
        jnp.concatenate([state.pose, others]),
        jnp.concatenate([state.twist, jnp.zeros_like(others)]),
    )


class ObjectOriented(AbstractModel):
    """One locally weighted regression per body and condition (OO-LWR).

    All conditions of a body share one table, at most two to the number of sectors of
    them; a condition that was never seen is answered by the one without contact.
    """

    features: BodyFeatures
    regressor: LocallyWeighted
    scene: Scene
    surroundings: Float[Array, "other 3"]
    """Poses of the scene's last bodies, which states do not have [m, m, rad]."""
    radius: Float[Array, ""]
    """How near something has to be to touch [m]."""
    num_sectors: int = eqx.field(static=True)
    num_rays: int = eqx.field(static=True)
    is_compiled: ClassVar[bool] = True

    def __init__(
        self,
        scene: Scene,
        regressor: LocallyWeighted | None = None,
        *,
        radius: float,
        surroundings: Float[Array, "other 3"] | None = None,
        num_sectors: int = 4,
        num_rays: int = 10,
        frame: str = "body",
        angles: bool = True,
    ):
        """Of the bodies of one scene.

        Args:
            scene: outlines, static ones included.
            regressor: settings; default: those of `LocallyWeighted`.
            radius: how near to its outline something has to be to touch a body [m].
            surroundings: poses of the scene's last bodies, such as walls, if states
                do not have them; these are to be static.
            num_sectors: sides of each body.
            num_rays: rays through each side.
            frame: `body` or `world`, see `BodyFeatures`.
            angles: whether headings, spins and torques count.

        Raises:
            ValueError: as `BodyFeatures`, a radius that is not positive, a count below
                one or more than eight sectors.
        """
        if not radius > 0:
            raise ValueError(f"radius: expected a positive length, got {radius}")
        check_at_least("num_rays", num_rays, 1)
        if not 1 <= num_sectors <= 8:
            raise ValueError(f"num_sectors: expected 1 to 8, got {num_sectors}")
        self.features = BodyFeatures(scene, frame=frame, angles=angles)
        self.regressor = LocallyWeighted() if regressor is None else regressor
        self.scene = scene
        self.surroundings = jnp.asarray(
            jnp.zeros((0, 3)) if surroundings is None else surroundings
        )
        self.radius = jnp.asarray(float(radius))
        self.num_sectors = num_sectors
        self.num_rays = num_rays

    def conditions(self, state: State) -> Int[Array, " moving"]:
        """The condition of each moving body.

        Args:
            state: of all bodies; not a number where it was not read.

        Returns:
            The sum of $2^s$ over sectors s with something next to them.
        """
        state = among(state, self.surroundings)

        def of(body: Array) -> Array:
            sectors = touched_sectors(
                self.scene,
                state,
                body,
                radius=self.radius,
                num_sectors=self.num_sectors,
                num_rays=self.num_rays,
            )
            return condition_number(sectors)

        return jax.vmap(of)(jnp.asarray(np.array(self.features.moving, np.int32)))

    def init(self, key: Key) -> LocalFit:
        """A fit to nothing for each moving body."""
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
        """Take one transition in, each body under its condition before the step."""
        del starts_episode  # Rows stand for themselves.
        row = self.features.row(state, wrench, next_state)
        return add_and_tune(self.regressor, learnt, *row, self.conditions(state))

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
        """What it expects of every body under its condition."""
        keys = jax.random.split(key, len(self.features.moving))
        outputs = jax.vmap(self.regressor.predict)(
            keys,
            hypothesis,
            self.features.inputs(state, wrench),
            self.conditions(state),
        )
        return self.features.next_state(state, outputs)
