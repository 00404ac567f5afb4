"""Brax's trainer runs on a task, learns it, and is left as it was found."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.envs import Pendulum
from boomdp_jax.interop import BraxTask, train_ppo

with warnings.catch_warnings():
    # Of a library that brax uses.
    warnings.simplefilter("ignore", DeprecationWarning)
    from brax.training.agents.ppo import train


@pytest.fixture(autouse=True)
def _as_brax_expects():
    """Brax adds vectors to matrices, and its networks are of 32 bit."""
    with jax.numpy_rank_promotion("allow"), jax.enable_x64(False):
        yield


def draws_of(env, factors):
    physics = env.sys.physics
    return jax.tree.map(lambda leaf: jnp.stack([leaf] * len(factors)), physics)


@pytest.mark.slow
def test_an_untrained_policy_acts_within_bounds():
    env = BraxTask(Pendulum())
    policy = train_ppo(env, num_timesteps=0, draws=draws_of(env, [1.0, 2.0]))
    action = np.asarray(policy.act(jnp.ones((5, 4))))
    assert action.shape == (5, 2)
    assert np.all(np.abs(action) <= 1.0)
    assert train.jax is jax


@pytest.mark.slow
def test_training_swings_the_pendulum_up():
    env = BraxTask(Pendulum())
    returns = []

    def note(_, metrics):
        returns.append(float(metrics["eval/episode_reward"]))

    policy = train_ppo(env, num_timesteps=1_500_000, progress_fn=note)
    # Hanging still costs π a step.
    assert returns[-1] > 0.6 * returns[0]
    assert float(policy.metrics["eval/episode_reward"]) == returns[-1]
    assert train.jax is jax
    assert not hasattr(train.jax, "device_put_replicated")


def test_the_trainer_is_left_as_it_was_when_training_fails():
    env = BraxTask(Pendulum())

    def fail(*_, **__):
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        train_ppo(env, num_timesteps=1, draws=draws_of(env, [1.0]), wrap_env_fn=fail)
    assert train.jax is jax


def test_a_negative_number_of_steps_is_refused():
    with pytest.raises(ValueError, match="num_timesteps: expected at least 0, got -1"):
        train_ppo(BraxTask(Pendulum()), num_timesteps=-1)
