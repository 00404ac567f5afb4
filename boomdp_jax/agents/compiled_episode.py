"""A whole episode as one compiled program, for models that are compiled throughout.

The loop of `run_episode` dispatches some ten programs a step; a decision on a cheap
model takes less than that. Here decisions are rounds of one loop on the device, each
with the steps for which it is held, and the loop ends where the episode does. Chance is
drawn from the same keys in the same order, so that both give the same episode, up to
what rounding does where two actions are all but equally good.

Seeds run one after the other through the one program, and each is written as it is
done: learning happens now and then (`AbstractRegressor.is_due`), which a `vmap` over
seeds would turn into always.
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from boomdp_jax.agents.agent import Agent
from boomdp_jax.agents.episode import (
    EpisodeRecord,
    position_error,
    read_state,
    scale_of_readings,
)
from boomdp_jax.core.arrays import IntScalar, Key
from boomdp_jax.envs.environment import AbstractEnvironment, EnvParams, EnvState
from boomdp_jax.physics.state import State
from boomdp_jax.planning.belief import Belief
from boomdp_jax.planning.plan import plan_of

RunEpisode = Callable[[Key], tuple[EpisodeRecord, PyTree]]
"""From a key to what happened, and what was learnt."""


def can_compile(agent: Agent) -> bool:
    """Whether an agent's whole episode is one program."""
    return agent.model.is_compiled and agent.explore is None


def compile_episode(
    task: AbstractEnvironment,
    params: EnvParams,
    agent: Agent,
    *,
    reading_noise: Float[Array, "4"] | None = None,
) -> RunEpisode:
    """Compile the episodes of an agent.

    Args:
        task: what is to be done.
        params: the world.
        agent: who does it, with a model that is compiled.
        reading_noise: as of `run_episode`.

    Returns:
        What `run_episode` is with these arguments, of a key. In its records
        `plan_seconds` is the time of the whole episode, learning included, in equal
        parts for all decisions, and `learn_seconds`, which cannot be told from it, is
        not a number; compilation counts in neither.

    Raises:
        ValueError: an agent whose model learns on the host, or that explores there;
            noise as of `run_episode`.
    """
    if not can_compile(agent):
        raise ValueError(
            f"agent: expected one whose model is compiled, without `explore`; got "
            f"{agent.name} with {type(agent.model).__name__}"
        )
    scale = scale_of_readings(reading_noise)
    jitted: Any = eqx.filter_jit(_episode)
    program = jitted.lower(jax.random.key(0), task, params, agent, scale)
    compiled = program.compile()

    def run(key: Key) -> tuple[EpisodeRecord, PyTree]:
        begin = time.perf_counter()
        rows, learnt = jax.block_until_ready(compiled(key, task, params, agent, scale))
        seconds = time.perf_counter() - begin
        is_decision = np.asarray(rows.is_decision)
        record = EpisodeRecord(
            reward=np.asarray(rows.reward, float),
            action=np.asarray(rows.action),
            state=np.asarray(rows.state, float),
            model_error=np.asarray(rows.model_error, float),
            plan_seconds=is_decision * (seconds / max(is_decision.sum(), 1)),
            learn_seconds=np.where(np.asarray(rows.action) >= 0, np.nan, 0.0),
        )
        return record, learnt

    return run


class _Rows(NamedTuple):
    """What is recorded of every step."""

    reward: Float[Array, " step"]
    action: Int[Array, " step"]
    state: Float[Array, "step body 6"]
    model_error: Float[Array, " step"]
    is_decision: Array


class _Now(NamedTuple):
    """Where an episode stands."""

    env: EnvState
    reading: State
    learnt: PyTree
    rows: _Rows


class _Round(NamedTuple):
    """A decision to come."""

    step: IntScalar
    sequence: PyTree
    """Planned by the decision before; to do nothing, if there is no such plan."""
    now: _Now


def _episode(
    key: Key,
    task: AbstractEnvironment,
    params: EnvParams,
    agent: Agent,
    scale: Float[Array, "4"],
) -> tuple[_Rows, PyTree]:
    """From the start to the end."""
    start_key, init_key, noise_key, act_key = jax.random.split(key, 4)
    _, env = task.reset(start_key, params)
    noise_keys = jax.random.split(noise_key, task.num_steps + 1)
    act_keys = jax.random.split(act_key, task.num_steps)
    dtype, num_steps = env.physics.pose.dtype, task.num_steps
    learnt = agent.model.init(init_key)
    rows = _Rows(
        reward=jnp.zeros(num_steps, dtype),
        action=jnp.full(num_steps, -1, jnp.int32),
        state=jnp.full((num_steps, env.physics.pose.shape[0], 6), jnp.nan, dtype),
        model_error=jnp.full(num_steps, jnp.nan, dtype),
        is_decision=jnp.zeros(num_steps, bool),
    )

    def decide(
        key: Key, belief: Belief, state: State, sequence: PyTree
    ) -> tuple[IntScalar, PyTree]:
        # As `Agent.decide`, with the same keys.
        key, try_key, any_key = jax.random.split(key, 3)
        anything = jax.random.randint(any_key, (), 0, task.num_actions)
        if (planner := agent.plan) is None:
            return anything.astype(jnp.int32), sequence

        def planned() -> tuple[IntScalar, PyTree]:
            plan = planner(key, belief, state, plan_of(sequence))
            return plan.index.astype(jnp.int32), plan.sequence

        if agent.exploration == 0:
            return planned()
        tries = jax.random.bernoulli(try_key, agent.exploration)
        nothing = jax.tree.map(jnp.zeros_like, sequence)
        return jax.lax.cond(
            tries, lambda: (anything.astype(jnp.int32), nothing), planned
        )

    def act(now: _Now, index: IntScalar, belief: Belief, step: IntScalar) -> _Now:
        before, wrench = now.env.physics, task.actions[index]
        _, env, reward, _, _ = task.step(None, now.env, index, params)
        reading = read_state(noise_keys[step + 1], env.physics, scale)
        error = position_error(
            act_keys[step], agent.model, belief, before, wrench, env.physics
        )
        learnt = agent.model.update(
            now.learnt, now.reading, wrench, reading, starts_episode=step == 0
        )
        old = now.rows
        rows = _Rows(
            reward=old.reward.at[step].set(reward.astype(dtype)),
            action=old.action.at[step].set(index),
            state=old.state.at[step].set(env.physics.array),
            model_error=old.model_error.at[step].set(error.astype(dtype)),
            is_decision=old.is_decision,
        )
        return _Now(env, reading, learnt, rows)

    def goes_on(step: IntScalar, now: _Now) -> Array:
        return (step < num_steps) & ~now.env.is_terminal

    def one_round(at: _Round) -> _Round:
        belief_key, plan_key = jax.random.split(act_keys[at.step])
        belief = agent.model.sample(belief_key, at.now.learnt, agent.num_hypotheses)
        index, sequence = decide(plan_key, belief, at.now.env.physics, at.sequence)
        marked = at.now.rows.is_decision.at[at.step].set(True)
        now = at.now._replace(rows=at.now.rows._replace(is_decision=marked))

        def held(now: _Now, step: IntScalar) -> tuple[_Now, None]:
            return jax.lax.cond(
                goes_on(step, now),
                lambda now: act(now, index, belief, step),
                lambda now: now,
                now,
            ), None

        steps = at.step + jnp.arange(agent.num_held, dtype=at.step.dtype)
        now, _ = jax.lax.scan(held, now, steps)
        return _Round(at.step + agent.num_held, sequence, now)

    first = _Round(
        step=jnp.zeros((), jnp.int32),
        sequence=_no_sequence(agent, env.physics, learnt),
        now=_Now(env, read_state(noise_keys[0], env.physics, scale), learnt, rows),
    )
    last = jax.lax.while_loop(lambda at: goes_on(at.step, at.now), one_round, first)
    return last.now.rows, last.now.learnt


def _no_sequence(agent: Agent, state: State, learnt: PyTree) -> PyTree:
    """Actions of a plan to do nothing."""
    planner = agent.plan
    if planner is None:
        return ()

    def plan(key: Key, learnt: PyTree, state: State) -> PyTree:
        belief = agent.model.sample(key, learnt, agent.num_hypotheses)
        return planner(key, belief, state, None).sequence

    shapes = jax.eval_shape(plan, jax.random.key(0), learnt, state)
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
