r"""A belief over which kind a thing is, of kinds that were learnt beforehand.

The papers' successor recognised furniture so: a prior over modes that were learnt on
single objects. Hypotheses are a fixed list of params; the weight of each is its prior
times the likelihood of the one-step predictions, with the noise of each channel group
integrated out (`inference.likelihoods.one_step`). Nothing outside the list is ever
found: a thing of no known kind is taken for the nearest one.

A pin holds a thing where it stands: the world's end of every pin is put, before each
row, where the thing's own anchor is.
"""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import BoolScalar, Key
from boomdp_jax.envs.environment import wrapped
from boomdp_jax.inference.likelihoods.one_step import (
    NoiseStatistics,
    group_sums,
    log_marginal,
)
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State
from boomdp_jax.physics.step import step
from boomdp_jax.planning.belief import Belief, resample

# Millimetres, milliradians, and what they make of rates within a step [m/s, rad/s].
_SCALE = (1e-3, 1e-3, 4e-3, 4e-3)


class KindsLearnt(eqx.Module):
    """How well each hypothesis has done."""

    params: Params
    """Leading axis `hypothesis`."""
    num: Float[Array, "1 4"]
    """Residuals by channel group."""
    square: Float[Array, "hypothesis 1 4"]
    """Sums of their squares."""


class KnownKinds(AbstractModel):
    """One body, which is of one of the kinds in a list."""

    scene: Scene
    params: Params
    """Of all kinds, leading axis `hypothesis`; several may be draws of one kind."""
    is_compiled: ClassVar[bool] = True

    def init(self, key: Key) -> KindsLearnt:
        """Each as likely as any other."""
        del key
        num = self.params.density.shape[0]
        return KindsLearnt(self.params, jnp.zeros((1, 4)), jnp.zeros((num, 1, 4)))

    def update(
        self,
        learnt: KindsLearnt,
        state: State,
        wrench: Float[Array, "body 3"],
        next_state: State,
        *,
        starts_episode: BoolScalar | bool = False,
    ) -> KindsLearnt:
        """Count one transition for and against each kind; a gap makes it count not."""
        del starts_episode  # Rows stand for themselves.
        read = jnp.concatenate([state.array, next_state.array], axis=-1)
        is_seen = jnp.all(jnp.isfinite(read))
        before = State(*(jnp.nan_to_num(part) for part in (state.pose, state.twist)))
        params = jax.vmap(lambda one: pinned_where_it_is(one, before))(learnt.params)

        def missed(one: Params) -> Array:
            told = step(self.scene, one, before, wrench)[0]
            error = told.array - next_state.array
            error = error.at[:, 2].set(wrapped(error[:, 2]))
            return group_sums(jnp.where(is_seen, error, 0.0)[None] ** 2)

        counts = group_sums(jnp.where(is_seen, jnp.ones_like(state.array), 0.0)[None])
        return KindsLearnt(
            params=jax.tree.map(
                lambda new, old: jnp.where(is_seen, new, old), params, learnt.params
            ),
            num=learnt.num + counts,
            square=learnt.square + jax.vmap(missed)(params),
        )

    def log_weight(self, learnt: KindsLearnt) -> Float[Array, " hypothesis"]:
        """Log-probability of each hypothesis, up to a constant."""
        scale = jnp.asarray(_SCALE, learnt.square.dtype)
        return jax.vmap(
            lambda square: log_marginal(NoiseStatistics(learnt.num, square), scale)
        )(learnt.square)

    def sample(self, key: Key, learnt: KindsLearnt, num_hypotheses: int) -> Belief:
        """Hypotheses drawn by their weights."""
        belief = Belief(learnt.params, self.log_weight(learnt))
        return resample(key, belief, num_hypotheses)

    def transition(
        self,
        key: Key,
        hypothesis: Params,
        state: State,
        wrench: Float[Array, "body 3"],
    ) -> State:
        """A step of the engine."""
        del key
        return step(self.scene, hypothesis, state, wrench)[0]


def pinned_where_it_is(params: Params, state: State) -> Params:
    """Move the world's ends of one body's pins to where the body's own are.

    Args:
        params: one hypothesis of a scene of one body.
        state: of the body.
    """
    cos, sin = jnp.cos(state.pose[0, 2]), jnp.sin(state.pose[0, 2])
    x, y = params.revolute.anchor_a[:, 0], params.revolute.anchor_a[:, 1]
    lever = jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    anchor = (state.pose[:1, :2] + lever).astype(params.revolute.anchor_b.dtype)
    pins = dataclasses.replace(params.revolute, anchor_b=anchor)
    return dataclasses.replace(params, revolute=pins)
