"""What is believed of all things of a room, each by itself.

Whoever knows the truth, or does not learn, believes the same from beginning to end;
`LearntRoom` keeps a `ThingModel` for each thing.
"""

import abc
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.arrays import Key
from boomdp_jax.core.random_numbers import host_generator
from boomdp_jax.core.thread_precision import in_this_precision
from boomdp_jax.envs.namo_room import Room, thing_scene
from boomdp_jax.models.kin import kin_draws, kin_odds
from boomdp_jax.models.thing_belief import (
    NUM_HYPOTHESES,
    Row,
    ThingLearnt,
    ThingModel,
    kind_shares,
)
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.planning.belief import Belief

# Odds of being of a kind that was tried, below which a thing is left as it was.
_LEAST_ODDS = 0.1
# Steps of a first push, for the sake of which programs are compiled beforehand.
_FEW_ROWS = 8
_COMPILER = ThreadPoolExecutor(max_workers=1)


class RoomBelief(abc.ABC):
    """Hypotheses about each thing."""

    @abc.abstractmethod
    def belief(self, thing: int) -> Belief:
        """Hypotheses about a thing."""

    @abc.abstractmethod
    def version(self, thing: int) -> int:
        """A number that changes when what is believed of it does."""

    @abc.abstractmethod
    def scene(self, thing: int) -> Scene:
        """The thing alone."""

    @abc.abstractmethod
    def update(self, key: Key, thing: int, rows: Sequence[Row]) -> None:
        """Learn from one push."""

    @abc.abstractmethod
    def shares(self, thing: int) -> dict[str, float]:
        """Probability of each kind of thing."""

    @abc.abstractmethod
    def warm_up(self) -> None:
        """Compile what learning needs, on a thread; the first lesson waits for it."""

    def mass(self, thing: int) -> float:
        """Expected mass of a thing [kg]."""
        belief = self.belief(thing)
        density = np.asarray(belief.hypotheses.density, float).reshape(-1)
        area = float(self.scene(thing).area[0])
        return area * float(density @ np.asarray(belief.weight, float))


class FixedRoom(RoomBelief):
    """One who does not learn."""

    def __init__(self, room: Room, hypotheses: Sequence[Params]):
        """Believe the same throughout.

        Args:
            room: what can be seen of it.
            hypotheses: about each thing, leading axis `hypothesis`.
        """
        self._scenes = [thing_scene(thing).scene for thing in room.things]
        self._beliefs = [
            Belief(one, jnp.zeros(one.density.shape[0])) for one in hypotheses
        ]
        self._force = room.robot.force

    def belief(self, thing: int) -> Belief:
        """Always the same."""
        return self._beliefs[thing]

    def version(self, thing: int) -> int:
        """Never changes."""
        del thing
        return 0

    def scene(self, thing: int) -> Scene:
        """The thing alone."""
        return self._scenes[thing]

    def update(self, key: Key, thing: int, rows: Sequence[Row]) -> None:
        """Nothing is learnt."""

    def warm_up(self) -> None:
        """Nothing is learnt."""

    def shares(self, thing: int) -> dict[str, float]:
        """Probability of each kind of thing."""
        belief = self._beliefs[thing]
        return kind_shares(
            belief.hypotheses,
            self._scenes[thing],
            self._force,
            np.asarray(belief.weight),
        )


class LearntRoom(RoomBelief):
    """An online posterior of each thing; of untouched ones, what their kin tell."""

    def __init__(
        self, key: Key, room: Room, *, is_point: bool = False, shares: bool = True
    ):
        """Begin with priors.

        Args:
            key: random key.
            room: what can be seen of it.
            is_point: whether only the most probable hypothesis is believed.
            shares: whether what was learnt of one thing tells of others like it.
        """
        self._rng = host_generator(jax.random.fold_in(key, 1))
        self._shares = shares
        self._models = [ThingModel(thing_scene(thing)) for thing in room.things]
        keys = jax.random.split(key, len(self._models))
        self._learnt: list[ThingLearnt] = [
            model.init(each) for model, each in zip(self._models, keys, strict=True)
        ]
        self._prior = [learnt.draws for learnt in self._learnt]
        self._num_told = [0] * len(self._learnt)
        self._num_labels = max(len({thing.label for thing in room.things}), 2)
        self._force = room.robot.force
        self._is_point = is_point
        self._compiled: Future | None = None

    def warm_up(self) -> None:
        """Compile what learning needs, on a thread; the first lesson waits for it."""

        def compile_all() -> None:
            for model in self._models:
                model.online.warm_up(_FEW_ROWS)

        self._compiled = _COMPILER.submit(in_this_precision(compile_all))

    def belief(self, thing: int) -> Belief:
        """Draws of the posterior; or the most probable structure's best numbers."""
        learnt = self._learnt[thing]
        if not self._is_point or self._num_told[thing]:
            return Belief(learnt.draws, jnp.zeros(NUM_HYPOTHESES))
        best = self._models[thing].online.best_params(learnt.belief)
        return Belief(
            jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], best), jnp.zeros(1)
        )

    def version(self, thing: int) -> int:
        """Pushes that were learnt from, of this thing or of its kin."""
        return self._learnt[thing].num_pushes + self._num_told[thing]

    def scene(self, thing: int) -> Scene:
        """The thing alone."""
        return self._models[thing].scene

    def update(self, key: Key, thing: int, rows: Sequence[Row]) -> None:
        """Learn from one push."""
        if self._compiled is not None:
            self._compiled.result()
            self._compiled = None
        self._learnt[thing] = self._models[thing].update(key, self._learnt[thing], rows)
        if self._shares:
            self._tell_kin()

    def _tell_kin(self) -> None:
        """Hypotheses about things that nobody has touched, drawn anew."""
        tried = [i for i, one in enumerate(self._learnt) if one.num_pushes > 0]
        for thing, learnt in enumerate(self._learnt):
            if learnt.num_pushes > 0:
                continue
            odds = kin_odds(
                self._models[thing].spec,
                [self._models[i].spec for i in tried],
                self._num_labels,
            )
            # What looks unlike all that was tried is expected to be what it was.
            if odds.sum() < _LEAST_ODDS:
                continue
            others = [self._learnt[i].draws for i in tried]
            draws = kin_draws(self._rng, self._prior[thing], others, odds)
            self._learnt[thing] = learnt._replace(draws=draws)
            self._num_told[thing] += 1

    def shares(self, thing: int) -> dict[str, float]:
        """Probability of each kind of thing."""
        model, learnt = self._models[thing], self._learnt[thing]
        if learnt.num_pushes == 0:
            weight = np.ones(learnt.draws.density.shape[0])
            return kind_shares(learnt.draws, model.scene, self._force, weight)
        posterior = model.online.posterior(learnt.belief, check=False)
        return kind_shares(
            posterior.params, model.scene, self._force, posterior.weights
        )

    def structure(self, thing: int) -> dict[str, float]:
        """Probability of each kind of constraint on a thing."""
        return self._models[thing].structure(self._learnt[thing])
