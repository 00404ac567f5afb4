r"""Point estimates of the physics: one best `Params`, no posterior.

What is made small is the squared error of one-step predictions, each number in units of
how far coasting misses it, with a weak pull to the middle of what is likely
(`physics_numbers`). Every constraint is always there, so nothing tells "no wheel" from
"a wheel that hardly brakes" but the value found. Between searches, which begin anew
from many starts when rows have grown by half, the estimate follows each row by a step
of Gauss-Newton, if that is how it searches.

This is what remains of learning physics without its uncertainty and without its
structure: a fair rival when data are many and clean, overconfident when they are few.
"""

import abc
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.core.arrays import BoolScalar, Key
from boomdp_jax.models.cma_es import cma_minimise
from boomdp_jax.models.features import BodyFeatures
from boomdp_jax.models.gauss_newton import gauss_newton, sum_of_squares
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.models.per_body import MovedFreely
from boomdp_jax.models.physics_numbers import PhysicsNumbers
from boomdp_jax.models.table import LEAST_ROWS, RETUNE_GROWTH, check_at_least
from boomdp_jax.models.true_model import Advance
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State
from boomdp_jax.physics.step import prepare_step, step
from boomdp_jax.planning.belief import Belief, certain

# Pull to the middle, in units of how far coasting misses one number of one row.
_PULL = 0.03
# Below these errors nothing counts [m, rad; m/s, rad/s].
_LEAST_ERROR = np.array([1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3])

ResidualFn = Callable[[Float[Array, " dim"]], Float[Array, " residual"]]


class AbstractSearch(eqx.Module):
    """How coordinates are found that make residuals small."""

    @abc.abstractmethod
    def improve(
        self,
        key: Key,
        residual_fn: ResidualFn,
        best: Float[Array, " dim"],
        is_due: BoolScalar,
    ) -> Float[Array, " dim"]:
        """Find coordinates no worse than the best so far.

        Args:
            key: random key.
            residual_fn: what is squared and summed.
            best: so far.
            is_due: whether to look everywhere; else one new row is to be taken into
                account, cheaply.

        Returns:
            The coordinates.
        """


class GaussNewton(AbstractSearch):
    """By derivatives of the engine, from random starts and the best so far."""

    num_starts: int = eqx.field(static=True, default=8)
    num_steps: int = eqx.field(static=True, default=15)
    """Of each start."""

    def __check_init__(self):
        check_at_least("num_starts", self.num_starts, 1)
        check_at_least("num_steps", self.num_steps, 1)

    def improve(
        self,
        key: Key,
        residual_fn: ResidualFn,
        best: Float[Array, " dim"],
        is_due: BoolScalar,
    ) -> Float[Array, " dim"]:
        """The best end of all starts, or one more step."""
        others = jax.random.normal(key, (self.num_starts, len(best)), best.dtype)
        starts = others.at[0].set(best)
        num_steps = jnp.where(is_due, self.num_steps, 1)

        # One start after the other, so that the engine is compiled for one only.
        def from_start(index: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
            point, loss = gauss_newton(residual_fn, starts[index], num_steps=num_steps)
            is_better = loss < found[1]
            return (
                jnp.where(is_better, point, found[0]),
                jnp.where(is_better, loss, found[1]),
            )

        first = (best, jnp.asarray(jnp.inf, best.dtype))
        num_starts = jnp.where(is_due, self.num_starts, 1)
        return jax.lax.fori_loop(0, num_starts, from_start, first)[0]


class CmaEs(AbstractSearch):
    """Without derivatives, from the middle and from the best so far."""

    num_generations: int = eqx.field(static=True, default=200)
    population: int = eqx.field(static=True, default=24)
    scale: float = eqx.field(static=True, default=0.7)
    """How far about its start a search looks at first."""

    def improve(
        self,
        key: Key,
        residual_fn: ResidualFn,
        best: Float[Array, " dim"],
        is_due: BoolScalar,
    ) -> Float[Array, " dim"]:
        """The best point of either search; between searches, the same."""

        def from_start(key: Key, start: Array) -> tuple[Array, Array]:
            found = cma_minimise(
                key,
                lambda z: sum_of_squares(residual_fn(z)),
                start,
                scale=self.scale,
                num_generations=self.num_generations,
                population=self.population,
            )
            return found.best, found.best_value

        def search(best: Array) -> Array:
            starts = jnp.stack([best, jnp.zeros_like(best)])
            points, losses = jax.vmap(from_start)(jax.random.split(key), starts)
            return points[jnp.argmin(losses)]

        return jax.lax.cond(is_due, search, lambda same: same, best)


class PointLearnt(eqx.Module):
    """Rows of all bodies, and the best coordinates so far."""

    state: State
    """With an axis `row`; zero where a number is missing."""
    wrench: Float[Array, "row body 3"]
    next_state: State
    mask: Bool[Array, "row body"]
    """Of which bodies every number was read, before and after."""
    z: Float[Array, "moving dim"]
    num_seen: Int[Array, ""]
    num_tuned: Int[Array, ""]
    key: Key


class PointFit(AbstractModel):
    """One best `Params`, by either search."""

    features: BodyFeatures
    numbers: PhysicsNumbers
    searcher: AbstractSearch
    capacity: int = eqx.field(static=True)
    advance: Advance | None = eqx.field(static=True)
    moved_freely: MovedFreely | None = eqx.field(static=True)
    is_compiled: ClassVar[bool] = True

    def __init__(
        self,
        scene: Scene,
        searcher: AbstractSearch | None = None,
        *,
        advance: Advance | None = None,
        moved_freely: MovedFreely | None = None,
        capacity: int = 200,
        has_pin: bool = False,
        friction: float = 0.3,
        restitution: float = 0.0,
    ):
        """Of the bodies of one scene.

        Args:
            scene: outlines and time step.
            searcher: how to search; default: `GaussNewton()`.
            advance: a step of the world under a hypothesis, for those who plan; it may
                know of walls. Default: the engine's step.
            moved_freely: which bodies touched nothing in a step; rows of the others do
                not count. Default: all count.
            capacity: newest rows that are kept.
            has_pin: whether each body may be pinned to the world besides.
            friction: of contact, where the scene has it; it is not learnt.
            restitution: likewise.

        Raises:
            ValueError: as `BodyFeatures`, or no room.
        """
        check_at_least("capacity", capacity, 1)
        self.features = BodyFeatures(scene, frame="world")
        self.numbers = PhysicsNumbers(
            scene=scene,
            moving=self.features.moving,
            has_pin=has_pin,
            friction=None if scene.collides is None else float(friction),
            restitution=float(restitution),
        )
        self.searcher = GaussNewton() if searcher is None else searcher
        self.capacity = capacity
        self.advance, self.moved_freely = advance, moved_freely

    def init(self, key: Key) -> PointLearnt:
        """No rows, and the middle of what is likely."""
        num = self.features.num_bodies
        zeros = jnp.zeros((self.capacity, num, 3))
        return PointLearnt(
            state=State(zeros, zeros),
            wrench=zeros,
            next_state=State(zeros, zeros),
            mask=jnp.zeros((self.capacity, num), bool),
            z=jnp.zeros((len(self.features.moving), self.numbers.dim)),
            num_seen=jnp.zeros((), jnp.int32),
            num_tuned=jnp.zeros((), jnp.int32),
            key=key,
        )

    def update(
        self,
        learnt: PointLearnt,
        state: State,
        wrench: Float[Array, "body 3"],
        next_state: State,
        *,
        starts_episode: BoolScalar | bool = False,
    ) -> PointLearnt:
        """Take one transition in; a row counts for the bodies that were read in full.

        Bodies that touch others which were not read are predicted as if these were at
        the origin: leave such rows out.
        """
        del starts_episode  # Rows stand for themselves.
        read = jnp.concatenate([state.array, wrench, next_state.array], axis=-1)
        is_seen = jnp.all(jnp.isfinite(read), axis=-1)
        if self.moved_freely is not None:
            is_seen = is_seen & self.moved_freely(state, next_state)
        is_row = jnp.any(is_seen[np.array(self.features.moving)])
        place = learnt.num_seen % self.capacity

        def put(column: Array, value: Array) -> Array:
            value = jnp.nan_to_num(value).astype(column.dtype)
            return column.at[place].set(jnp.where(is_row, value, column[place]))

        search_key, later_key = jax.random.split(learnt.key)
        taken = PointLearnt(
            state=jax.tree.map(put, learnt.state, state),
            wrench=put(learnt.wrench, wrench),
            next_state=jax.tree.map(put, learnt.next_state, next_state),
            mask=put(learnt.mask, is_seen),
            z=learnt.z,
            num_seen=learnt.num_seen + is_row,
            num_tuned=learnt.num_tuned,
            key=later_key,
        )
        residual_fn = self._residual_fn(taken)
        flat = taken.z.reshape(-1)
        is_due = taken.num_seen >= jnp.maximum(
            RETUNE_GROWTH * taken.num_tuned, LEAST_ROWS
        )
        flat = self.searcher.improve(search_key, residual_fn, flat, is_due)
        num_tuned = jnp.where(is_due, taken.num_seen, taken.num_tuned)
        return eqx.tree_at(
            lambda one: (one.z, one.num_tuned),
            taken,
            (flat.reshape(taken.z.shape), num_tuned),
        )

    def sample(self, key: Key, learnt: PointLearnt, num_hypotheses: int) -> Belief:
        """The one hypothesis, a `Params`."""
        del key, num_hypotheses
        return certain(self.params(learnt))

    def transition(
        self,
        key: Key,
        hypothesis: Params,
        state: State,
        wrench: Float[Array, "body 3"],
    ) -> State:
        """A step of the engine, or of the world as `advance` has it."""
        del key
        if self.advance is not None:
            return self.advance(hypothesis, state, wrench)
        return step(self.numbers.scene, hypothesis, state, wrench)[0]

    def params(self, learnt: PointLearnt) -> Params:
        """The estimate.

        Args:
            learnt: so far.

        Returns:
            The params; the middle of what is likely if nothing was seen.
        """
        return self.numbers.params(learnt.z, self._mean_pose(learnt))

    def _mean_pose(self, learnt: PointLearnt) -> Float[Array, "moving 4"]:
        """Means of place, and of cosine and sine of the heading."""
        index = np.array(self.features.moving)
        weight = learnt.mask[:, index, None].astype(learnt.z.dtype)
        pose = learnt.state.pose[:, index]
        angle = pose[..., 2:]
        parts = jnp.concatenate([pose[..., :2], jnp.cos(angle), jnp.sin(angle)], -1)
        return jnp.sum(weight * parts, axis=0) / jnp.maximum(jnp.sum(weight, 0), 1.0)

    def _residual_fn(self, learnt: PointLearnt) -> ResidualFn:
        """Errors of one-step predictions, and the pull, of flat coordinates."""
        index = np.array(self.features.moving)
        scene, mean_pose = self.numbers.scene, self._mean_pose(learnt)
        weight = learnt.mask[:, index, None].astype(learnt.z.dtype)
        missed = jax.vmap(self.features.targets)(learnt.state, learnt.next_state)
        num = jnp.maximum(jnp.sum(weight, axis=0), 1.0)
        unit = jnp.sqrt(jnp.sum(weight * missed**2, axis=0) / num)
        unit = unit + jnp.asarray(_LEAST_ERROR, unit.dtype)[None]

        def residual(z: Float[Array, " dim"]) -> Float[Array, " residual"]:
            params = self.numbers.params(z.reshape(learnt.z.shape), mean_pose)
            advance = prepare_step(scene, params)

            def of_row(state: State, wrench: Array, after: State) -> Array:
                told, _ = advance(state, wrench)
                error = self.features.targets(state, told)
                return error - self.features.targets(state, after)

            error = jax.vmap(of_row)(learnt.state, learnt.wrench, learnt.next_state)
            # What a row without numbers would say must not even be not a number.
            error = jnp.where(weight > 0, error / unit[None], 0.0)
            return jnp.concatenate([error.reshape(-1), _PULL * z])

        return residual
