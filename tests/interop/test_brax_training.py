"""Brax's trainer runs on a task, learns it, and is left as it was found."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.envs import Pendulum
from boomdp_jax.interop import BraxTask, train_ppo
from boomdp_jax.physics.scene_spec import scene_spec_from_dict
from tests.inference.made_posteriors import table_posterior

with warnings.catch_warnings():
    # Of a library that brax uses.
    warnings.simplefilter("ignore", DeprecationWarning)
    from brax.training.agents.ppo import train


@pytest.fixture(autouse=True)
def _as_brax_expects():
    """It adds vectors to matrices."""
    with jax.numpy_rank_promotion("allow"):
        yield


def draws_of(env, factors):
    """Bobs of other masses."""
    physics, factors = env.sys.physics, jnp.asarray(factors)
    scale = jax.vmap(
        lambda factor: eqx.tree_at(
            lambda p: p.density, physics, factor * physics.density
        )
    )
    return scale(factors)


@pytest.mark.slow
def test_training_swings_the_pendulum_up():
    env = BraxTask(Pendulum())
    returns = []

    def note(_, metrics):
        returns.append(float(metrics["eval/episode_reward"]))

    policy = train_ppo(
        env,
        num_timesteps=1_500_000,
        draws=draws_of(env, [0.8, 1.2]),
        progress_fn=note,
    )
    # Hanging still costs π a step; what is upright costs nothing.
    assert len(returns) == 2
    assert returns[-1] > 0.6 * returns[0]
    assert float(policy.metrics["eval/episode_reward"]) == returns[-1]
    action = np.asarray(policy.act(jax.random.normal(jax.random.key(0), (64, 4))))
    assert action.shape == (64, 2)
    assert np.all(np.abs(action) <= 1.0)
    assert train.jax is jax


def test_the_trainer_is_left_as_it_was_when_training_fails():
    env = BraxTask(Pendulum())

    def fail(*_, **__):
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        train_ppo(env, num_timesteps=1, draws=draws_of(env, [1.0]), wrap_env_fn=fail)
    assert train.jax is jax


def test_a_posterior_of_other_bodies_is_refused():
    with pytest.raises(ValueError, match="draws: expected bodies bob, got table"):
        train_ppo(BraxTask(Pendulum()), draws=table_posterior(num_draws=8))


def test_a_posterior_of_another_outline_is_refused():
    env = Pendulum()
    content = env.spec.to_dict()
    content["bodies"][0]["shape"] = {"type": "circle", "radius": 9.0}
    posterior = table_posterior(num_draws=8, spec=scene_spec_from_dict(content))
    with pytest.raises(ValueError, match="draws: body 'bob': shape"):
        train_ppo(BraxTask(env), draws=posterior)


def test_a_negative_number_of_steps_is_refused():
    with pytest.raises(ValueError, match="num_timesteps: expected at least 0, got -1"):
        train_ppo(BraxTask(Pendulum()), num_timesteps=-1)


@pytest.mark.usefixtures("no_type_checks")
def test_what_is_no_task_of_brax_or_no_hypothesis_is_refused():
    with pytest.raises(TypeError, match=r"^env: expected a BraxTask, got Pendulum$"):
        train_ppo(Pendulum())
    with pytest.raises(TypeError, match=r"^draws: expected Params or .* got str$"):
        train_ppo(BraxTask(Pendulum()), draws="x")
