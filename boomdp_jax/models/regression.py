"""A model made of one regression per body: any regressor, in either frame."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from boomdp_jax.core.arrays import BoolScalar, Key
from boomdp_jax.models.features import BodyFeatures
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State
from boomdp_jax.planning.belief import Belief, resample


class AbstractRegressor(eqx.Module):
    """From rows of inputs and targets to predictions, of one body.

    What is cheap is done with every row (`add`), what is costly only now and then
    (`tune`, when `is_due` says so), and what predictions have in common once for all of
    them (`prepare`).
    """

    @abc.abstractmethod
    def init(self, key: Key, num_inputs: int, num_outputs: int) -> PyTree:
        """What is known without rows.

        Args:
            key: random key.
            num_inputs: columns of what goes in.
            num_outputs: columns of what comes out.

        Returns:
            A fit to nothing, which predicts zeros.
        """

    @abc.abstractmethod
    def add(
        self,
        fit: PyTree,
        inputs: Float[Array, " input"],
        targets: Float[Array, " output"],
        is_seen: BoolScalar,
    ) -> PyTree:
        """Take one row in, unless it was not seen; then it may hold anything finite."""

    @abc.abstractmethod
    def is_due(self, fit: PyTree) -> BoolScalar:
        """Whether settings should be chosen anew."""

    @abc.abstractmethod
    def tune(self, fit: PyTree) -> PyTree:
        """Choose settings anew, from all rows there are."""

    @abc.abstractmethod
    def prepare(self, fit: PyTree) -> PyTree:
        """Hypotheses of equal weight, with a leading axis `hypothesis`."""

    @abc.abstractmethod
    def predict(
        self, key: Key, hypothesis: PyTree, inputs: Float[Array, " input"]
    ) -> Float[Array, " output"]:
        """What one hypothesis expects."""


class BodyRegression(AbstractModel):
    """One regression for each body that moves; bodies know nothing of each other.

    Under `vmap` over learners settings would be chosen anew with every row, as both
    sides of a condition are then worked out; run several learners by `lax.map`.
    """

    features: BodyFeatures
    regressor: AbstractRegressor
    is_compiled: ClassVar[bool] = True

    def __init__(
        self,
        scene: Scene,
        regressor: AbstractRegressor,
        *,
        frame: str = "body",
        angles: bool = True,
    ):
        """Of the bodies of one scene.

        Args:
            scene: what moves, and for how long a step.
            regressor: how rows become predictions.
            frame: `body` (what is learnt holds anywhere) or `world` (it may depend on
                the place), see `BodyFeatures`.
            angles: whether headings, spins and torques count.

        Raises:
            ValueError: as `BodyFeatures`.
        """
        self.features = BodyFeatures(scene, frame=frame, angles=angles)
        self.regressor = regressor

    def init(self, key: Key) -> PyTree:
        """A fit to nothing for each moving body."""
        return fit_to_nothing(key, self.features, self.regressor)

    def update(
        self,
        learnt: PyTree,
        state: State,
        wrench: Float[Array, "body 3"],
        next_state: State,
        *,
        starts_episode: BoolScalar | bool = False,
    ) -> PyTree:
        """Take one transition in; bodies of which a number is missing learn nothing."""
        del starts_episode  # Rows stand for themselves.
        row = self.features.row(state, wrench, next_state)
        return add_and_tune(self.regressor, learnt, *row)

    def sample(self, key: Key, learnt: PyTree, num_hypotheses: int) -> Belief:
        """The regressor's hypotheses, at most so many of them, drawn evenly."""
        hypotheses = jax.vmap(self.regressor.prepare, out_axes=1)(learnt)
        num = jax.tree.leaves(hypotheses)[0].shape[0]
        return resample(key, Belief(hypotheses, jnp.zeros(num)), num_hypotheses)

    def transition(
        self,
        key: Key,
        hypothesis: PyTree,
        state: State,
        wrench: Float[Array, "body 3"],
    ) -> State:
        """What one hypothesis expects of every body by itself."""
        keys = jax.random.split(key, len(self.features.moving))
        outputs = jax.vmap(self.regressor.predict)(
            keys, hypothesis, self.features.inputs(state, wrench)
        )
        return self.features.next_state(state, outputs)


def fit_to_nothing(
    key: Key, features: BodyFeatures, regressor: AbstractRegressor
) -> PyTree:
    """What a regressor knows of each moving body before anything was seen.

    Args:
        key: random key.
        features: of the bodies.
        regressor: the same for all.

    Returns:
        Its fits, leading axis `moving`.
    """
    num_inputs, num_outputs = features.num_inputs, features.num_outputs
    keys = jax.random.split(key, len(features.moving))
    return jax.vmap(lambda one: regressor.init(one, num_inputs, num_outputs))(keys)


def add_and_tune(regressor: AbstractRegressor, learnt: PyTree, *row: Array) -> PyTree:
    """Take one row of each moving body in, and choose settings where that is due.

    Args:
        regressor: of each body.
        learnt: fits so far, leading axis `moving`.
        row: arguments of `regressor.add` after the fit, leading axis `moving`.

    Returns:
        The fits now.
    """
    learnt = jax.vmap(regressor.add)(learnt, *row)
    is_due = jnp.any(jax.vmap(regressor.is_due)(learnt))
    return jax.lax.cond(is_due, jax.vmap(regressor.tune), lambda same: same, learnt)
