"""What an agent may be taught before its first episode: unbiased samples of a world.

The papers' pre-trained agents had "2000 unbiased samples from the reachable set". Here
random pushes, each held as long as a decision, go on for 400 steps from 50 random
starts, goals being nothing to stop at, and every tenth step is a sample. All learners
are taught the same ones, read with the run's own noise; none of them goes on learning.
Samples are shuffled and the walks are of that length even where fewer samples are asked
for, so that the first so many are from the same states as all.
A regression takes in all. A physics posterior takes in the first of them that touched
nothing, as many as its table has room for: beyond that numbers are known to a
hundredth of a percent, and the time of a fit grows with its rows.
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from boomdp_jax.agents.episode import read_state, scale_of_readings
from boomdp_jax.core.arrays import Key
from boomdp_jax.core.history import make_history
from boomdp_jax.envs.environment import AbstractEnvironment, EnvParams
from boomdp_jax.models.fixed_belief import FixedBelief
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.models.physics_model import PhysicsModel
from boomdp_jax.physics.state import State, state_from_array
from boomdp_jax.planning.belief import Belief

NUM_SAMPLES = 2000
_NUM_ROLLOUTS, _EVERY = 50, 10
_NUM_DRAWS = 64
"""Hypotheses kept of a physics posterior."""


class Samples(NamedTuple):
    """Transitions, in no order, on the host."""

    state: Float[np.ndarray, "sample body 6"]
    wrench: Float[np.ndarray, "sample body 3"]
    next_state: Float[np.ndarray, "sample body 6"]
    is_free: Bool[np.ndarray, "sample body"]
    """Which bodies touched nothing, as an observer can tell."""

    def of_body(self, body: int) -> "Samples":
        """Those in which a body was pushed, of that body alone."""
        is_pushed = np.any(self.wrench[:, body] != 0, axis=-1)
        return Samples(*(part[is_pushed][:, [body]] for part in self))

    def first(self, num: int) -> "Samples":
        """So many rows; if there are fewer, the last ones were not read."""
        more = max(num - len(self.state), 0)
        fills = (np.nan, 0.0, np.nan, False)
        return Samples(
            *(
                np.concatenate(
                    [part[:num], np.full((more, *part.shape[1:]), fill, part.dtype)]
                )
                for part, fill in zip(self, fills, strict=True)
            )
        )


def unbiased_samples(
    key: Key,
    task: AbstractEnvironment,
    params: EnvParams,
    *,
    reading_noise: Float[Array, "4"] | None = None,
    num_samples: int = NUM_SAMPLES,
) -> Samples:
    """Push at random, from many starts, and keep a step now and then.

    Args:
        key: random key, of no episode.
        task: what moves.
        params: the world.
        reading_noise: standard deviation of readings, as of `run_episode`.
        num_samples: how many; walks are longer where they are more than usual.

    Returns:
        The samples, in random order.
    """
    scale = scale_of_readings(reading_noise)
    key, order_key = jax.random.split(key)
    num_each = -(-max(num_samples, NUM_SAMPLES) // _NUM_ROLLOUTS)
    sample = jax.jit(functools.partial(_rollout, task, num_each=num_each))
    keys = jax.random.split(key, _NUM_ROLLOUTS)
    rows = jax.vmap(lambda one: sample(one, params, scale))(keys)
    flat = [np.asarray(part).reshape(-1, *part.shape[2:]) for part in rows]
    order = np.asarray(jax.random.permutation(order_key, len(flat[0])))[:num_samples]
    return Samples(*(part[order] for part in flat))


def _rollout(
    task: AbstractEnvironment,
    key: Key,
    params: EnvParams,
    scale: Float[Array, "4"],
    *,
    num_each: int,
) -> tuple[Array, ...]:
    """Samples from one start."""
    start_key, push_key, noise_key = jax.random.split(key, 3)
    num_held = task.hints.action_repeat
    num_pushes = -(-num_each * _EVERY // num_held)
    pushes = jax.random.randint(push_key, (num_pushes,), 0, task.num_actions)

    def advance(number: Array, states: tuple[State, State]) -> tuple[State, State]:
        state = states[1]
        wrench = task.actions[pushes[number // num_held]].astype(state.pose.dtype)
        return state, task.happens(params.physics, state, wrench)

    def block(state: State, number: Array) -> tuple[State, tuple[Array, ...]]:
        first = number * _EVERY
        before, after = jax.lax.fori_loop(
            first, first + _EVERY, advance, (state, state)
        )
        wrench = task.actions[pushes[(first + _EVERY - 1) // num_held]]
        keys = jax.random.split(jax.random.fold_in(noise_key, number))
        read = [
            read_state(one, state, scale).array
            for one, state in zip(keys, (before, after), strict=True)
        ]
        return after, (read[0], wrench, read[1], task.moved_freely(before, after))

    start = task.start(start_key, params)
    return jax.lax.scan(block, start, jnp.arange(num_each))[1]


def taught(key: Key, model: AbstractModel, samples: Samples) -> FixedBelief:
    """What a model makes of samples, and leaves it at that.

    Args:
        key: random key.
        model: a `PhysicsModel`, or one that is compiled.
        samples: of its bodies.

    Returns:
        A model of what was learnt.
    """
    key, draw_key = jax.random.split(key)
    if isinstance(model, PhysicsModel):
        online = model.online
        rows = np.flatnonzero(samples.is_free.all(axis=1))[: online.capacity]
        state, wrench, next_state = (part[rows] for part in samples[:3])
        dt = float(online.spec.dt)
        history = make_history(
            state, wrench, next_state, dt, episode=np.arange(len(rows))
        )
        belief = online.init(key, history)
        draws = online.sample_params(draw_key, belief, _NUM_DRAWS)
        return FixedBelief(Belief(draws, jnp.zeros(_NUM_DRAWS)), model)
    told = (jnp.asarray(part, float) for part in samples[:3])
    learnt = _taken_in(model, model.init(key), *told)
    return FixedBelief(eqx.filter_jit(_sampled)(model, draw_key, learnt), model)


@eqx.filter_jit
def _taken_in(
    model: AbstractModel, learnt: Any, state: Array, wrench: Array, next_state: Array
) -> Any:
    """One row after the other."""

    def take(learnt: Any, row: tuple[Array, Array, Array]) -> tuple[Any, None]:
        before, wrench, after = row
        learnt = model.update(
            learnt, state_from_array(before), wrench, state_from_array(after)
        )
        return learnt, None

    return jax.lax.scan(take, learnt, (state, wrench, next_state))[0]


def _sampled(model: AbstractModel, key: Key, learnt: Any) -> Any:
    return model.sample(key, learnt, _NUM_DRAWS)
