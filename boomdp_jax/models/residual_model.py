r"""Physics, and a regression of what it misses where it was seen to miss it.

A hypothesis of the physics, $f$, says of every transition that was seen what should
have come, and a regression $r$ learns the rest in the frame of each body (Ajay et al.
2018, Augmenting physical simulators with stochastic neural networks; Zeng et al. 2019,
TossingBot, call it residual physics). The prediction is, number by number,

$$f(s, a) + \lambda \, e^{-d^2 / 2 b^2} \, r(s, a),$$

so that physics is left alone where nothing speaks against it:

- d is the distance of twist and wrench from the nearest row that was learnt from, in
  standard deviations of all rows, and b three times what it is from row to row: far
  from data the regression does not count;
- λ in [0, 1] is chosen for each of six numbers by errors on rows held out. Rows are
  dealt to `NUM_FOLDS` folds; each is predicted by a regression of the others, λ and
  the distance as well as settings of the regression being those without it. λ is the
  least-squares factor of these predictions, and zero unless it makes the squared error
  smaller by more than the standard error of that difference (Breiman et al. 1984,
  Classification and regression trees, 3.4.3, the one-standard-error rule).

Each hypothesis has a regression of its own, fitted anew to its own rest for each
decision, since what physics misses changes as physics learns. Where physics says that
something is run into, or comes to rest, it is taken at its word.
"""

from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, Key
from boomdp_jax.models.features import BodyFeatures
from boomdp_jax.models.locally_weighted import LocallyWeighted
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.models.regression import AbstractRegressor
from boomdp_jax.models.table import (
    Scaling,
    check_at_least,
    scaling_of,
    squared_distances,
)
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State
from boomdp_jax.planning.belief import Belief

MovedFreely = Callable[[State, State], Bool[Array, " body"]]
Halted = Callable[[State, State], State]

NUM_FOLDS = 5
"""Each is predicted by the others."""
FEWEST_ROWS = 10
"""Rows below which physics is left alone: two of each fold."""

# For the regression of a rest: few settings, as it is fitted for each decision, each
# fold and each hypothesis.
_BANDWIDTHS, _RIDGES = (0.6, 1.5, 4.0), (1e-3, 1e-1)
# In units of the distance from a row to the nearest other one, root mean square, and
# the least of it in standard deviations, for rows that are all but the same.
_REACH, _LEAST_REACH = 3.0, 0.1
# A rest so small is rounding [m, rad and their rates, squared].
_LEAST_SQUARE = 1e-12


class Rows(eqx.Module):
    """Transitions that were seen: a ring with a mask."""

    state: State
    wrench: Float[Array, "row body 3"]
    next_state: State
    is_free: Bool[Array, "row moving"]
    """Whether a body was read, and touched nothing."""
    num_seen: Int[Array, ""]


class ResidualLearnt(NamedTuple):
    """What has been learnt, on the host."""

    physics: PyTree
    rows: Rows


class Residual(eqx.Module):
    """What one hypothesis of the physics misses of one body."""

    fit: PyTree
    """Hypotheses of the regressor, with a leading axis; their mean counts."""
    scaling: Scaling
    points: Float[Array, "*batch row input"]
    """Standardised inputs that were learnt from; far away where there is no row."""
    reach: Float[Array, "*batch"]
    """Distance over which it fades, in standardised units."""
    share: Float[Array, "*batch output"]
    """λ."""


class Corrected(eqx.Module):
    """A hypothesis: of the physics, and what it misses of each moving body."""

    physics: PyTree
    residual: Residual


class ResidualPhysics(AbstractModel):
    """Physics, corrected by what it was seen to miss where it was seen.

    Prefer it to physics alone where the law itself may be wrong, at the price of some
    thousandths of a second for each decision and of slower planning; where the physics
    is right it does no harm and no good.
    """

    physics: AbstractModel
    features: BodyFeatures
    regressor: AbstractRegressor
    capacity: int = eqx.field(static=True)
    moved_freely: MovedFreely | None = eqx.field(static=True)
    halted: Halted | None = eqx.field(static=True)
    is_compiled: ClassVar[bool] = False

    def __init__(
        self,
        physics: AbstractModel,
        scene: Scene,
        regressor: AbstractRegressor | None = None,
        *,
        capacity: int = 96,
        moved_freely: MovedFreely | None = None,
        halted: Halted | None = None,
    ):
        """Set up.

        Args:
            physics: the model whose rest is learnt; any will do.
            scene: its bodies.
            regressor: learns the rest, from at least `capacity` rows; default: locally
                weighted regression.
            capacity: newest transitions that the rest is learnt from.
            moved_freely: which bodies touched nothing in a step, as in `PhysicsModel`;
                default: all.
            halted: where a step ends that might run into something, from the states
                before and after it; default: where it would.

        Raises:
            ValueError: fewer rows than `FEWEST_ROWS`; as `BodyFeatures`.
        """
        check_at_least("capacity", capacity, FEWEST_ROWS)
        self.physics = physics
        self.features = BodyFeatures(scene, frame="body")
        self.regressor = regressor or LocallyWeighted(
            capacity=capacity,
            num_neighbours=capacity,
            num_held_out=capacity,
            bandwidths=_BANDWIDTHS,
            ridges=_RIDGES,
        )
        self.capacity = capacity
        self.moved_freely = moved_freely
        self.halted = halted

    def init(self, key: Key) -> ResidualLearnt:
        """What physics knows, and no rows."""
        shape = (self.capacity, self.features.num_bodies, 3)
        nowhere = State(jnp.zeros(shape), jnp.zeros(shape))
        num_moving = len(self.features.moving)
        rows = Rows(
            state=nowhere,
            wrench=jnp.zeros(shape),
            next_state=nowhere,
            is_free=jnp.zeros((self.capacity, num_moving), bool),
            num_seen=jnp.zeros((), jnp.int32),
        )
        return ResidualLearnt(self.physics.init(key), rows)

    def update(
        self,
        learnt: ResidualLearnt,
        state: State,
        wrench: Float[Array, "body 3"],
        next_state: State,
        *,
        starts_episode: BoolScalar | bool = False,
    ) -> ResidualLearnt:
        """Let physics take the transition in, and keep it."""
        physics = self.physics.update(
            learnt.physics, state, wrench, next_state, starts_episode=starts_episode
        )
        return ResidualLearnt(
            physics, _taken(self, learnt.rows, state, wrench, next_state)
        )

    def sample(self, key: Key, learnt: ResidualLearnt, num_hypotheses: int) -> Belief:
        """The physics' hypotheses, each with what it misses."""
        physics_key, residual_key = jax.random.split(key)
        belief = self.physics.sample(physics_key, learnt.physics, num_hypotheses)
        residual = _residuals(self, residual_key, belief.hypotheses, learnt.rows)
        return Belief(Corrected(belief.hypotheses, residual), belief.log_weight)

    def transition(
        self,
        key: Key,
        hypothesis: Corrected,
        state: State,
        wrench: Float[Array, "body 3"],
    ) -> State:
        """What physics expects, and the rest where it is known."""
        physics_key, residual_key = jax.random.split(key)
        told = self.physics.transition(physics_key, hypothesis.physics, state, wrench)
        keys = jax.random.split(residual_key, len(self.features.moving))
        rest = jax.vmap(self._rest)(
            keys, hypothesis.residual, self.features.inputs(state, wrench)
        )
        rest = jnp.where(self._is_free(state, told)[:, None], rest, 0.0)
        # As a difference, so that without a rest not a bit of the physics changes.
        with_rest = self.features.next_state(state, rest)
        without = self.features.next_state(state, jnp.zeros_like(rest))
        moved = jax.tree.map(lambda a, b, c: a + (b - c), told, with_rest, without)
        return moved if self.halted is None else self.halted(state, moved)

    def _is_free(self, state: State, next_state: State) -> Bool[Array, " moving"]:
        """Which moving bodies touched nothing in a step."""
        index = np.array(self.features.moving)
        if self.moved_freely is None:
            return jnp.ones(len(index), bool)
        return self.moved_freely(state, next_state)[index]

    def _rest(
        self, key: Key, residual: Residual, inputs: Float[Array, " input"]
    ) -> Float[Array, " output"]:
        """What is added to the physics of one body."""
        told = _mean_prediction(self.regressor, key, residual.fit, inputs)
        point = residual.scaling(inputs)[None]
        square = jnp.min(squared_distances(point, residual.points))
        return residual.share * jnp.exp(-0.5 * square / residual.reach**2) * told

    def _residual_of(self, key: Key, hypothesis: PyTree, rows: Rows) -> Residual:
        """What one hypothesis misses, of each moving body."""
        physics_key, fit_key = jax.random.split(key)
        keys = jax.random.split(physics_key, self.capacity)
        told = jax.vmap(lambda k, s, w: self.physics.transition(k, hypothesis, s, w))(
            keys, rows.state, rows.wrench
        )
        inputs = jax.vmap(self.features.inputs)(rows.state, rows.wrench)
        missed = jax.vmap(self.features.targets)(rows.state, rows.next_state)
        missed = missed - jax.vmap(self.features.targets)(rows.state, told)
        # Nothing can be said of rows for which physics foretells a stop.
        mask = rows.is_free & jax.vmap(self._is_free)(rows.state, told)
        fit_keys = jax.random.split(fit_key, len(self.features.moving))
        return jax.vmap(self._fitted, in_axes=(0, 1, 1, 1))(
            fit_keys, inputs, missed, mask
        )

    def _fitted(
        self,
        key: Key,
        inputs: Float[Array, "row input"],
        missed: Float[Array, "row output"],
        mask: Bool[Array, " row"],
    ) -> Residual:
        """The regression of one body, and how much of it counts."""
        learn_key, predict_key = jax.random.split(key)
        fold = (jnp.cumsum(mask) - 1) % NUM_FOLDS
        # The last leaves out no fold. All are one program, as compiling takes seconds.
        learnt = mask[None] & (fold[None] != jnp.arange(NUM_FOLDS + 1)[:, None])
        keys = jax.random.split(learn_key, NUM_FOLDS + 1)
        each = jax.vmap(lambda k, rows: self._learn(k, inputs, missed, rows))(
            keys, learnt
        )
        keys = jax.random.split(predict_key, len(inputs))
        told = jax.vmap(
            lambda rest: jax.vmap(lambda k, row: self._rest(k, rest, row))(keys, inputs)
        )(jax.tree.map(lambda leaf: leaf[:-1], each))
        told = jnp.sum(
            jnp.where((mask[None] & ~learnt[:-1])[..., None], told, 0.0), axis=0
        )
        share = jax.vmap(_share_of, in_axes=(1, 1, None))(told, missed, mask)
        whole = jax.tree.map(lambda leaf: leaf[-1], each)
        return eqx.tree_at(lambda one: one.share, whole, share)

    def _learn(
        self,
        key: Key,
        inputs: Float[Array, "row input"],
        missed: Float[Array, "row output"],
        mask: Bool[Array, " row"],
    ) -> Residual:
        """The regression of some rows, all of which counts."""
        fit = self.regressor.init(key, inputs.shape[1], missed.shape[1])

        def take(fit: PyTree, row: tuple) -> tuple[PyTree, None]:
            return self.regressor.add(fit, *row), None

        clean = jnp.where(mask[:, None], missed, 0.0)
        fit = jax.lax.scan(take, fit, (inputs, clean, mask))[0]
        scaling = scaling_of(inputs, mask)
        far = jnp.sqrt(jnp.finfo(inputs.dtype).max) * 1e-3
        points = jnp.where(mask[:, None], scaling(inputs), far)
        return Residual(
            fit=self.regressor.prepare(self.regressor.tune(fit)),
            scaling=scaling,
            points=points,
            reach=_reach_of(points, mask),
            share=jnp.ones(missed.shape[1], inputs.dtype),
        )


@eqx.filter_jit
def _taken(
    model: ResidualPhysics,
    rows: Rows,
    state: State,
    wrench: Float[Array, "body 3"],
    next_state: State,
) -> Rows:
    """One transition more, in place of the oldest; none if no body was free."""
    index = np.array(model.features.moving)
    numbers = jnp.concatenate([state.array, next_state.array, wrench], axis=-1)
    is_read = jnp.all(jnp.isfinite(numbers), axis=-1)[index]
    is_free = is_read & model._is_free(state, next_state)
    is_any = jnp.any(is_free)
    place = rows.num_seen % model.capacity

    def put(column: Array, value: Array) -> Array:
        new = jnp.nan_to_num(value.astype(column.dtype))
        return column.at[place].set(jnp.where(is_any, new, column[place]))

    old = (rows.state, rows.wrench, rows.next_state, rows.is_free)
    kept = jax.tree.map(put, old, (state, wrench, next_state, is_free))
    return Rows(*kept, rows.num_seen + is_any.astype(rows.num_seen.dtype))


@eqx.filter_jit
def _residuals(
    model: ResidualPhysics, key: Key, hypotheses: PyTree, rows: Rows
) -> Residual:
    """What each hypothesis misses."""
    num = jax.tree.leaves(hypotheses)[0].shape[0]
    keys = jax.random.split(key, num)
    return jax.vmap(lambda k, one: model._residual_of(k, one, rows))(keys, hypotheses)


def _mean_prediction(
    regressor: AbstractRegressor,
    key: Key,
    fit: PyTree,
    inputs: Float[Array, " input"],
) -> Float[Array, " output"]:
    """Of a regressor's hypotheses."""
    num = jax.tree.leaves(fit)[0].shape[0]
    keys = jax.random.split(key, num)
    told = jax.vmap(lambda k, one: regressor.predict(k, one, inputs))(keys, fit)
    return jnp.mean(told, axis=0)


def _reach_of(
    points: Float[Array, "row input"], mask: Bool[Array, " row"]
) -> FloatScalar:
    """How far from a row the regression counts: some times the way to the next one."""
    gaps = squared_distances(points, points)
    is_other = mask[:, None] & mask[None] & ~jnp.eye(len(points), dtype=bool)
    nearest = jnp.min(jnp.where(is_other, gaps, jnp.inf), axis=1)
    has_other = jnp.isfinite(nearest)
    square = jnp.sum(jnp.where(has_other, nearest, 0.0))
    square = square / jnp.maximum(jnp.sum(has_other), 1)
    return jnp.maximum(_REACH * jnp.sqrt(square), _LEAST_REACH)


def _share_of(
    told: Float[Array, " row"], missed: Float[Array, " row"], mask: Bool[Array, " row"]
) -> FloatScalar:
    """How much of a regression counts, by predictions of rows held out."""
    weight = mask.astype(missed.dtype)
    num = jnp.sum(weight)
    missed = jnp.where(mask, missed, 0.0)
    square = jnp.sum(told**2)
    share = jnp.sum(told * missed) / jnp.maximum(square, _LEAST_SQUARE)
    share = jnp.clip(share, 0.0, 1.0)
    gain = missed**2 - (missed - share * told) ** 2
    mean = jnp.sum(gain) / jnp.maximum(num, 1.0)
    spread = jnp.sum(weight * (gain - mean) ** 2) / jnp.maximum(num - 1.0, 1.0)
    error = jnp.sqrt(spread / jnp.maximum(num, 1.0))
    return jnp.where((num >= FEWEST_ROWS) & (mean > error), share, 0.0)
