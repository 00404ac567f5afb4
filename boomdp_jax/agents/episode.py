"""One episode: an agent acts, sees what comes of it, and learns."""

import functools
import time
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, PyTree

from boomdp_jax.agents.agent import Agent
from boomdp_jax.core.arrays import BoolScalar, FloatScalar, Key
from boomdp_jax.core.checked_input import reading_scale
from boomdp_jax.envs.environment import AbstractEnvironment, EnvParams
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.physics.state import State, state_from_array
from boomdp_jax.planning.belief import Belief

CHANNEL_GROUP = (0, 0, 1, 2, 2, 3)
"""Group of each channel of a state: position, angle, velocity, spin."""


class EpisodeRecord(NamedTuple):
    """What happened, step by step, on the host.

    After the goal was reached rewards are zero; actions are −1 there, states NaN.
    """

    reward: Float[np.ndarray, " step"]
    action: Int[np.ndarray, " step"]
    """Index into the task's actions."""
    state: Float[np.ndarray, "step body 6"]
    """After each step, as it is and not as it was read."""
    model_error: Float[np.ndarray, " step"]
    """Error of the position that the model foretold for each step, from the state as it
    is, with what was learnt up to the decision: root mean square over bodies, mean over
    hypotheses [m]."""
    plan_seconds: Float[np.ndarray, " step"]
    """Of sampling hypotheses and planning; zero where a decision was carried on. Of an
    episode compiled whole, its time in equal parts, learning included."""
    learn_seconds: Float[np.ndarray, " step"]
    """Not a number in an episode compiled whole, where it cannot be told."""

    @property
    def num_done(self) -> int:
        """Steps until the goal was reached, or the episode's length."""
        return int(np.sum(self.action >= 0))


def run_episode(
    key: Key,
    task: AbstractEnvironment,
    params: EnvParams,
    agent: Agent,
    *,
    reading_noise: Float[Array, "4"] | None = None,
    learnt: PyTree = None,
) -> tuple[EpisodeRecord, PyTree]:
    """Let an agent act from the beginning to the end of one episode.

    What is learnt from may be read with noise; plans start from the state as it is, as
    in the papers, where noise was on training observations. Compiled parts are shared
    by all episodes of a task and an agent.

    Args:
        key: random key; decides start, noise and all of the agent's chance.
        task: what is to be done.
        params: the world.
        agent: who does it.
        reading_noise: standard deviation of readings that the model learns from, of
            position [m], angle [rad], velocity [m/s] and spin [rad/s]; none: exact.
        learnt: by the agent's model beforehand; none: nothing.

    Returns:
        What happened, and what the model has learnt now.

    Raises:
        ValueError: noise that is not four numbers, or one that is negative or not
            finite.
    """
    scale = scale_of_readings(reading_noise)
    start_key, init_key, noise_key, act_key = jax.random.split(key, 4)
    compiled = _compiled(task)
    _, now = compiled.reset(start_key, params)
    if learnt is None:
        learnt = agent.model.init(init_key)
    noise_keys = jax.random.split(noise_key, task.num_steps + 1)
    act_keys = jax.random.split(act_key, task.num_steps)
    reading = read_state(noise_keys[0], now.physics, scale)
    record = _empty_record(task.num_steps, now.physics.pose.shape[0])
    is_compiled = agent.model.is_compiled
    sample = _compiled_sample if is_compiled else _sample
    update = _compiled_update if is_compiled else _update
    plan, belief, index, num_left = None, None, 0, 0
    for step in range(task.num_steps):
        if bool(now.is_terminal):
            break
        if num_left == 0 or belief is None:
            begin = time.perf_counter()
            belief_key, plan_key = jax.random.split(act_keys[step])
            belief = sample(agent.model, belief_key, learnt, agent.num_hypotheses)
            chosen, plan = agent.decide(
                plan_key, belief, now.physics, plan, task.num_actions, learnt
            )
            index, num_left = int(chosen), agent.num_held
            record.plan_seconds[step] = time.perf_counter() - begin
        before = now.physics
        _, now, reward, _, _ = compiled.step(None, now, index, params)
        next_reading = read_state(noise_keys[step + 1], now.physics, scale)
        error = position_error(
            act_keys[step],
            agent.model,
            belief,
            before,
            task.actions[index],
            now.physics,
        )
        begin = time.perf_counter()
        learnt = update(
            agent.model,
            learnt,
            reading,
            task.actions[index],
            next_reading,
            jnp.asarray(step == 0),
        )
        jax.block_until_ready(learnt)
        record.learn_seconds[step] = time.perf_counter() - begin
        record.reward[step] = reward
        record.action[step] = index
        record.state[step] = np.asarray(now.physics.array)
        record.model_error[step] = error
        reading = next_reading
        num_left -= 1
    return record, learnt


def scale_of_readings(
    reading_noise: Float[Array, "4"] | None,
) -> Float[Array, "4"]:
    """Standard deviations for `read_state`; checked unless they are traced.

    Args:
        reading_noise: as of `run_episode`.
    """
    if reading_noise is None:
        return jnp.zeros(4)
    if not isinstance(reading_noise, Tracer):
        reading_scale("reading_noise", reading_noise)
    return jnp.asarray(reading_noise)


class _Compiled(NamedTuple):
    """A task's functions, compiled once."""

    reset: Callable
    step: Callable


@functools.lru_cache(maxsize=64)
def _compiled(task: AbstractEnvironment) -> _Compiled:
    return _Compiled(jax.jit(task.reset), jax.jit(task.step))


def _sample(model: AbstractModel, key: Key, learnt: PyTree, num: int) -> Belief:
    return model.sample(key, learnt, num)


def _update(
    model: AbstractModel,
    learnt: PyTree,
    state: State,
    wrench: Float[Array, "body 3"],
    next_state: State,
    starts_episode: BoolScalar,
) -> PyTree:
    return model.update(
        learnt, state, wrench, next_state, starts_episode=starts_episode
    )


_compiled_sample, _compiled_update = eqx.filter_jit(_sample), eqx.filter_jit(_update)


@jax.jit
def read_state(key: Key, state: State, scale: Float[Array, "4"]) -> State:
    """A reading of a state; exact where the scale is zero.

    Args:
        key: random key.
        state: as it is.
        scale: standard deviation of position [m], angle [rad], velocity [m/s] and spin
            [rad/s].
    """
    noise = jax.random.normal(key, state.array.shape, state.pose.dtype)
    scale = scale[jnp.array(CHANNEL_GROUP)].astype(noise.dtype)
    return state_from_array(state.array + scale[None] * noise)


@eqx.filter_jit
def position_error(
    key: Key,
    model: AbstractModel,
    belief: Belief,
    state: State,
    wrench: Float[Array, "body 3"],
    next_state: State,
) -> FloatScalar:
    """How far off the foretold positions are, on average over hypotheses [m].

    Args:
        key: for models that are random in themselves.
        model: whose hypotheses are asked.
        belief: these, and their weights.
        state: before the step.
        wrench: held over it [N, N, N m].
        next_state: after it.
    """
    foretold = jax.vmap(lambda each: model.transition(key, each, state, wrench))(
        belief.hypotheses
    )
    away = foretold.pose[..., :2] - next_state.pose[None, :, :2]
    error = jnp.sqrt(jnp.mean(jnp.sum(away**2, axis=-1), axis=-1))
    return jnp.sum(belief.weight * error)


def _empty_record(num_steps: int, num_bodies: int) -> EpisodeRecord:
    return EpisodeRecord(
        reward=np.zeros(num_steps),
        action=np.full(num_steps, -1),
        state=np.full((num_steps, num_bodies, 6), np.nan),
        model_error=np.full(num_steps, np.nan),
        plan_seconds=np.zeros(num_steps),
        learn_seconds=np.zeros(num_steps),
    )
