"""What a robot believes of one piece of furniture, before and after it was pushed.

An `OnlineBelief` of the thing alone takes every step in which the robot held it, with
the wrench that the wrist felt. After each push hypotheses are drawn for the planner.
Before anything was pushed they are drawn from the prior, or from what was learnt of
others like it (`models.kin`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import Key
from boomdp_jax.inference.online.belief import OnlineBelief
from boomdp_jax.inference.online.state import BeliefState
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.physics.state import State

NUM_HYPOTHESES = 32
"""Drawn for a planner."""
_CAPACITY, _NUM_PARTICLES = 64, 256
# Pushes after which the belief is fitted anew, whether it asks for that or not: prior
# particles are too few for what a single push tells.
_FIRST_REFITS = 2


class Row(NamedTuple):
    """One step in which a thing was held; of the thing alone."""

    before: State
    wrench: Float[Array, "1 3"]
    after: State
    begins: bool
    """Whether the thing may have moved since the row before."""


class ThingLearnt(NamedTuple):
    """What has been learnt of a thing, on the host."""

    belief: BeliefState
    draws: Params
    """Hypotheses, leading axis `hypothesis`."""
    num_pushes: int
    """Learnt from."""


class ThingModel:
    """Settings and compiled functions for one thing."""

    def __init__(self, spec: SceneSpec):
        """Set up, for a scene of one body."""
        self.spec = spec
        self.scene: Scene = spec.scene
        self.online = OnlineBelief(
            spec,
            capacity=_CAPACITY,
            num_particles=_NUM_PARTICLES,
            # Whether a push opens a way hardly depends on how well a mass is known.
            num_noise_levels=1,
            # Furniture stays what it is.
            change_rate=0.0,
        )

    def init(self, key: Key) -> ThingLearnt:
        """The prior."""
        belief_key, draw_key = jax.random.split(key)
        belief = self.online.init(belief_key)
        draws = self.online.sample_params(draw_key, belief, NUM_HYPOTHESES)
        return ThingLearnt(belief, draws, 0)

    def update(self, key: Key, learnt: ThingLearnt, rows: Sequence[Row]) -> ThingLearnt:
        """Learn from one push.

        Args:
            key: random key.
            learnt: so far.
            rows: its steps, one after another.

        Returns:
            What is known then, with fresh hypotheses.
        """
        belief, asks = learnt.belief, False
        for row in rows:
            belief, info = self.online.step(
                belief,
                row.before,
                row.wrench,
                row.after,
                starts_episode=row.begins,
            )
            asks = asks or bool(info.needs_refit)
        num_pushes = learnt.num_pushes + 1
        if asks or num_pushes <= _FIRST_REFITS:
            belief, _ = self.online.refit(belief)
        draws = self.online.sample_params(key, belief, NUM_HYPOTHESES)
        return ThingLearnt(belief, draws, num_pushes)

    def structure(self, learnt: ThingLearnt) -> dict[str, float]:
        """Probability of each constraint, by its kind."""
        posterior = self.online.posterior(learnt.belief, check=False)
        weight = posterior.weights
        num = len(weight)

        def share(active: Array) -> float:
            return float(np.asarray(active).reshape(num, -1).any(axis=1) @ weight)

        params = posterior.params
        return {
            kind: share(getattr(params, kind).active)
            for kind in ("revolute", "wheel", "ground")
        }


def kind_shares(
    params: Params, scene: Scene, force: float, weight: Float[np.ndarray, " draw"]
) -> dict[str, float]:
    """Share of hypotheses of each kind (`envs.namo_room.KINDS`).

    A thing with a pin turns, one with a wheel rolls; of the others those are heavy that
    need more than half of the robot's force to slide, and those fixed that need more
    than all of it.

    Args:
        params: hypotheses about a lone thing, leading axis `draw`.
        scene: of the thing.
        force: the robot's [N].
        weight: of each.
    """
    weight = np.asarray(weight, float) / np.sum(weight)
    num = len(weight)
    area, load = float(scene.area[0]), float(scene.normal_gravity)
    mass = np.asarray(params.density, float).reshape(num) * area

    def active(slots) -> np.ndarray:
        return np.any(np.asarray(slots.active).reshape(num, -1), axis=1)

    rubs = np.asarray(params.ground.dry, float).reshape(num, -1)
    rubs = np.where(np.asarray(params.ground.active).reshape(num, -1), rubs, 0.0)
    resists = rubs.sum(axis=1) * mass * load
    pinned, rolls = active(params.revolute), active(params.wheel)
    slides = ~pinned & ~rolls
    each = {
        "free": slides & (resists < 0.5 * force),
        "heavy": slides & (resists >= 0.5 * force) & (resists < force),
        "wheels": rolls & ~pinned,
        "revolute": pinned,
        "fixed": slides & (resists >= force),
    }
    return {kind: float(mask @ weight) for kind, mask in each.items()}


def lone_state(state: State, body: int) -> State:
    """One body's part of a state."""
    return State(
        jnp.asarray(state.pose[body])[None], jnp.asarray(state.twist[body])[None]
    )
