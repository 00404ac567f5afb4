"""Pendulum and acrobot: held by their pins, and too heavy for their motors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.envs import Acrobot, Pendulum
from boomdp_jax.envs import acrobot as acrobot_module
from boomdp_jax.envs import pendulum as pendulum_module
from boomdp_jax.envs.pendulum import angle_from_upright
from boomdp_jax.physics import constraint_error


def held_action(task, action, num_steps, key):
    params = task.default_params()
    _, state = task.reset(key, params)

    def one(state, _):
        _, state, reward, _, _ = task.step(None, state, action, params)
        return state, (state.physics, reward)

    return jax.jit(lambda s: jax.lax.scan(one, s, None, length=num_steps)[1])(state)


@pytest.mark.slow
@pytest.mark.parametrize("make", [Pendulum, Acrobot])
def test_starts_obey_the_pins(make):
    task = make()
    params = task.default_params()
    keys = jax.random.split(jax.random.key(0), 32)
    states = jax.jit(jax.vmap(lambda key: task.start(key, params)))(keys)
    known = jax.vmap(lambda s: constraint_error(task.spec.scene, params.physics, s))
    assert float(jnp.max(known(states))) < 1e-6


def test_no_held_force_lifts_the_bob():
    """With a share f of the weight the bob goes no higher than twice asin f."""
    task = Pendulum()
    highest = 2 * np.arcsin(pendulum_module.FORCE_SHARE) + 1.1 / np.sqrt(
        pendulum_module.GRAVITY / pendulum_module.LENGTH
    )
    params = task.default_params()
    still = params.__class__(**{**vars(params), "start_spread": jnp.zeros((1, 3))})
    _, state = task.reset(jax.random.key(0), still)

    def run(action):
        def one(state, _):
            _, state, _, _, _ = task.step(None, state, action, still)
            return state, angle_from_upright(state.physics)

        return jax.lax.scan(one, state, None, length=300)[1]

    nearest = jnp.min(jax.jit(jax.vmap(run))(jnp.arange(task.num_actions)), axis=1)
    assert float(jnp.min(nearest)) > np.pi - highest
    # Pushed along x it does move.
    assert float(nearest[0]) < np.pi - 0.5


def test_a_bob_that_is_let_go_keeps_its_energy():
    """m v²/2 (1 + k²/L²) + m g y, with k² = r²/2 of a disc."""
    states, _ = held_action(Pendulum(), 8, 100, jax.random.key(9))
    speed = np.linalg.norm(np.asarray(states.twist[:, 0, :2]), axis=1)
    share = pendulum_module.RADIUS**2 / 2 / pendulum_module.LENGTH**2
    energy = 0.5 * (1 + share) * speed**2
    energy = energy + pendulum_module.GRAVITY * np.asarray(states.pose[:, 0, 1])
    scale = pendulum_module.GRAVITY * pendulum_module.LENGTH
    assert np.ptp(energy) < 0.02 * scale
    assert np.ptp(speed) > 0.5


def test_the_reward_is_the_angle_from_upright():
    states, reward = held_action(Pendulum(), 8, 20, jax.random.key(5))
    x, y = np.asarray(states.pose[:, 0, 0]), np.asarray(states.pose[:, 0, 1])
    np.testing.assert_allclose(reward, -np.abs(np.arctan2(x, y)), atol=1e-9)
    # The heading that the arm gives the bob tells the same.
    heading = np.asarray(states.pose[:, 0, 2])
    np.testing.assert_allclose(np.cos(heading), -np.cos(np.asarray(reward)), atol=1e-3)


@pytest.mark.slow
def test_the_tip_costs_its_depth():
    states, reward = held_action(Acrobot(), 1, 20, jax.random.key(6))
    pose = np.asarray(states.pose[:, 1])
    tip = pose[:, 1] - acrobot_module.LINK / 2 * np.cos(pose[:, 2])
    np.testing.assert_allclose(reward, -(2 * acrobot_module.LINK - tip), atol=1e-4)
