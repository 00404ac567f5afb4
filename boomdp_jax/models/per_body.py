"""One model for each body: what is learnt of a chair says nothing of a table.

The papers' object-oriented MDP: a joint model of a room has as many inputs as all its
bodies together, while one action moves one body. Each body has a model of a scene of
its own, in which it is alone; a planner takes all of them at once along an axis.
"""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from boomdp_jax.core.arrays import BoolScalar, Key
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State
from boomdp_jax.physics.step import step
from boomdp_jax.planning.belief import Belief

MovedFreely = Callable[[State, State], Bool[Array, " body"]]


class ScenePhysics(eqx.Module):
    """The engine's step as a law of one scene, which is data."""

    scene: Scene

    def transition(
        self,
        key: Key,
        hypothesis: PyTree,
        state: State,
        wrench: Float[Array, "body 3"],
    ) -> State:
        """As `AbstractModel.transition`, with Φ as the hypothesis."""
        del key
        return step(self.scene, hypothesis, state, wrench)[0]


class PerBodyLearnt(NamedTuple):
    """What has been learnt of each body, on the host."""

    parts: tuple[PyTree, ...]
    """Of each body's model."""
    draws: PyTree
    """Hypotheses, leading axes `hypothesis body`; drawn anew when a body's model learns
    something, and now and then for a decision."""
    is_broken: tuple[bool, ...]
    """Whether a body has moved since its model was last told."""
    keys: Key


class PerBody(AbstractModel):
    """The first bodies of a scene, each with a model of its own; the rest stay.

    A step teaches the model of a body if a wrench acted on that body. `transition`
    takes each body by itself: nothing touches.
    """

    models: tuple[AbstractModel, ...]
    """Of scenes of one body, all of one kind, so that what they learn stacks."""
    laws: Any
    """Anything with `transition`, leading axis `body`."""
    num_hypotheses: int = eqx.field(static=True)
    moved_freely: MovedFreely | None = eqx.field(static=True)
    sees_others: bool = eqx.field(static=True)
    """Whether each model is of the whole room, and `laws` have `transition_among`."""
    is_compiled: ClassVar[bool] = False

    def __init__(
        self,
        models: tuple[AbstractModel, ...],
        laws: Any,
        *,
        num_hypotheses: int,
        moved_freely: MovedFreely | None = None,
        sees_others: bool = False,
    ):
        """Set up.

        Args:
            models: one for each of the first bodies.
            laws: `transition` of each, with a leading axis `body`; see `stacked`.
            num_hypotheses: drawn from each model.
            moved_freely: which bodies touched nothing in a step; the others then learn
                nothing. Default: all learn.
            sees_others: whether each model is told of the whole room, such as
                `ObjectAmongOthers`, or of its body alone.

        Raises:
            ValueError: no model, or fewer hypotheses than one.
        """
        if not models:
            raise ValueError("models: expected at least one, got none")
        if num_hypotheses < 1:
            raise ValueError(
                f"num_hypotheses: expected at least 1, got {num_hypotheses}"
            )
        self.models, self.laws = tuple(models), laws
        self.num_hypotheses = num_hypotheses
        self.moved_freely = None if moved_freely is None else jax.jit(moved_freely)
        self.sees_others = sees_others

    def init(self, key: Key) -> PerBodyLearnt:
        """Nothing of any body."""
        num = len(self.models)
        key, *keys = jax.random.split(key, num + 1)
        parts = tuple(
            model.init(each) for model, each in zip(self.models, keys, strict=True)
        )
        draws = [
            _drawn(model, each, part, self.num_hypotheses)
            for model, each, part in zip(self.models, keys, parts, strict=True)
        ]
        stack = jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *draws)
        return PerBodyLearnt(parts, stack, (True,) * num, key)

    def update(
        self,
        learnt: PerBodyLearnt,
        state: State,
        wrench: Float[Array, "body 3"],
        next_state: State,
        *,
        starts_episode: BoolScalar | bool = False,
    ) -> PerBodyLearnt:
        """Take one transition in, for the bodies on which a wrench acted."""
        num = len(self.models)
        is_free = np.ones(num, bool)
        if self.moved_freely is not None:
            is_free = np.asarray(self.moved_freely(state, next_state))[:num]
        is_pushed = np.any(np.asarray(wrench)[:num] != 0, axis=1)
        parts, broken = list(learnt.parts), [True] * num
        key, draws = learnt.keys, learnt.draws
        for body in map(int, np.flatnonzero(is_pushed & is_free)):
            model = self.models[body]
            update = _compiled_update if model.is_compiled else _update
            parts[body] = update(
                model,
                parts[body],
                *(
                    (state, jnp.asarray(wrench), next_state)
                    if self.sees_others
                    else (
                        _only(state, body),
                        jnp.asarray(wrench)[body][None],
                        _only(next_state, body),
                    )
                ),
                jnp.asarray(learnt.is_broken[body] or bool(starts_episode)),
            )
            broken[body] = False
            key, draw_key = jax.random.split(key)
            fresh = _drawn(model, draw_key, parts[body], self.num_hypotheses)
            draws = jax.tree.map(_put(body), draws, fresh)
        return PerBodyLearnt(tuple(parts), draws, tuple(broken), key)

    def sample(self, key: Key, learnt: PerBodyLearnt, num_hypotheses: int) -> Belief:
        """The draws at hand, of equal weight; those of one body, whichever, are new.

        Draws at hand change when their body learns. One that is pinned in all of them
        is never pushed, and so would never learn that it is not.
        """
        del num_hypotheses
        body_key, draw_key = jax.random.split(key)
        body = int(jax.random.randint(body_key, (), 0, len(self.models)))
        fresh = _drawn(
            self.models[body], draw_key, learnt.parts[body], self.num_hypotheses
        )
        draws = jax.tree.map(_put(body), learnt.draws, fresh)
        return Belief(jax.tree.map(jnp.asarray, draws), jnp.zeros(self.num_hypotheses))

    def transition(
        self,
        key: Key,
        hypothesis: PyTree,
        state: State,
        wrench: Float[Array, "body 3"],
    ) -> State:
        """Each body by itself; bodies without a model stay where they are."""
        num = len(self.models)
        lone = State(state.pose[:num, None], state.twist[:num, None])
        keys = jax.random.split(key, num)

        def move(law: Any, *row: Any) -> State:
            if self.sees_others:
                return law.transition_among(*row, state.pose)
            return law.transition(*row)

        moved = jax.vmap(move)(self.laws, keys, hypothesis, lone, wrench[:num, None])
        return State(
            state.pose.at[:num].set(moved.pose[:, 0]),
            state.twist.at[:num].set(moved.twist[:, 0]),
        )


def stacked(laws: list) -> Any:
    """Laws of equal shapes side by side, for `PerBody`."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *laws)


def _only(state: State, body: int) -> State:
    return State(state.pose[body][None], state.twist[body][None])


def _put(body: int) -> Callable[[np.ndarray, Array | np.ndarray], np.ndarray]:
    def put(old: np.ndarray, new: Array | np.ndarray) -> np.ndarray:
        changed = np.array(old)
        changed[:, body] = new
        return changed

    return put


def _drawn(model: AbstractModel, key: Key, part: PyTree, num: int) -> PyTree:
    """So many hypotheses, each as often as its weight says."""
    sample = _compiled_sample if model.is_compiled else _sample
    belief = sample(model, key, part, num)
    weight = np.asarray(belief.weight, float)
    # Systematic, from the middle of each share: equal weights give each its turn.
    places = (np.arange(num) + 0.5) / num
    index = np.searchsorted(np.cumsum(weight / weight.sum()), places - 1e-9)
    index = np.minimum(index, len(weight) - 1)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[index], belief.hypotheses)


def _update(
    model: AbstractModel,
    part: PyTree,
    state: State,
    wrench: Float[Array, "body 3"],
    next_state: State,
    starts_episode: BoolScalar,
) -> PyTree:
    return model.update(part, state, wrench, next_state, starts_episode=starts_episode)


def _sample(model: AbstractModel, key: Key, part: PyTree, num: int) -> Belief:
    return model.sample(key, part, num)


_compiled_update, _compiled_sample = eqx.filter_jit(_update), eqx.filter_jit(_sample)
