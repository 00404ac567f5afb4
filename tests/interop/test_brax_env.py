"""Tasks before brax: its wrappers see the task's own steps, ends and worlds."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.envs import Acrobot, Cart, LivingRoom, Pendulum
from boomdp_jax.interop import (
    BraxTask,
    continuous_actions,
    register_brax_envs,
    task_randomisation,
)
from boomdp_jax.interop.brax_env import _check_task
from boomdp_jax.physics import State

with warnings.catch_warnings():
    # Of a library that brax uses.
    warnings.simplefilter("ignore", DeprecationWarning)
    from brax import envs

NUM_WORLDS = 3
TASKS = [
    pytest.param(Pendulum, id="pendulum"),
    pytest.param(Cart, id="cart", marks=pytest.mark.slow),
]


@pytest.fixture(scope="module", params=TASKS)
def env(request):
    return BraxTask(request.param(num_steps=50))


def raw_keys(seed, num=NUM_WORLDS):
    """As brax makes them."""
    return jax.random.split(jax.random.PRNGKey(seed), num)


def numbers_of(env, index):
    """An action for a listed wrench: least squares on what each number does."""
    basis = np.asarray(env.actions.basis[0]).reshape(env.action_size, -1)
    listed = np.asarray(env.task.actions.wrench[index]).reshape(-1)
    return jnp.asarray(np.linalg.lstsq(basis.T, listed)[0])


def test_it_moves_as_the_task_does(env):
    task, params = env.task, env.task.default_params()
    indices = [0, 2, 1, task.num_actions - 1]
    state, step = env.reset(jax.random.PRNGKey(4)), jax.jit(env.step)
    obs, own = task.reset(jax.random.key(4), params)
    own_step = jax.jit(task.step)
    np.testing.assert_array_equal(state.obs, obs)
    for index in indices:
        state = step(state, numbers_of(env, index))
        obs, own, reward, _, _ = own_step(None, own, index, params)
        np.testing.assert_allclose(state.obs, obs, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(state.reward, reward, rtol=1e-5)
        np.testing.assert_allclose(
            state.info["wrench"], task.actions[index], rtol=1e-5, atol=1e-6
        )
    assert int(state.pipeline_state.time) == len(indices)


def test_it_is_an_environment_of_brax(env):
    assert isinstance(env, envs.Env)
    assert env.unwrapped is env
    assert env.backend == "boomdp_jax"
    assert env.reset(jax.random.key(0)).obs.shape == (env.observation_size,)
    assert env.action_size == continuous_actions(env.task.actions).size
    assert float(env.dt) == float(env.task.scene.dt)


def test_wrappers_repeat_actions_and_begin_anew_when_time_is_up(env):
    wrapped = envs.training.wrap(env, episode_length=4, action_repeat=2)
    step = jax.jit(wrapped.step)
    first = jax.jit(wrapped.reset)(raw_keys(1))
    action = jnp.full((NUM_WORLDS, env.action_size), 0.5)
    assert first.obs.shape == (NUM_WORLDS, env.observation_size)
    once = step(first, action)
    alone, one_step = jax.vmap(env.reset)(raw_keys(1)), jax.jit(jax.vmap(env.step))
    middle = one_step(alone, action)
    last = one_step(middle, action)
    np.testing.assert_allclose(once.obs, last.obs, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(once.reward, middle.reward + last.reward, rtol=1e-5)
    np.testing.assert_array_equal(once.done, 0.0)
    twice = step(once, action)
    np.testing.assert_array_equal(twice.done, 1.0)
    np.testing.assert_array_equal(twice.info["truncation"], 1.0)
    np.testing.assert_array_equal(twice.obs, first.obs)
    np.testing.assert_array_equal(twice.pipeline_state.time, 0)
    again = step(twice, action)
    np.testing.assert_allclose(again.obs, once.obs, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(again.done, 0.0)


def cart_before_its_goal():
    """A push along x of the first world's cart ends its episode."""
    task = Cart()
    params = task.default_params()
    turned = params.start.at[0, 2].set(0.0)
    near = turned.at[0, 0].add(0.6)
    return task, eqx.tree_at(
        lambda p: (p.goal, p.start, p.start_spread), params, (near, turned, 0 * turned)
    )


@pytest.mark.slow
def test_a_goal_that_is_reached_ends_the_episode_and_is_no_truncation():
    wrapped = envs.training.wrap(
        BraxTask(*cart_before_its_goal()), episode_length=500, action_repeat=3
    )
    first = wrapped.reset(raw_keys(0, 2))
    np.testing.assert_array_equal(first.done, 0.0)
    state, step = first, jax.jit(wrapped.step)
    action = jnp.array([[1.0, 0.0], [0.0, 0.0]])
    for _ in range(8):
        state = step(state, action)
        if state.done[0]:
            break
    np.testing.assert_array_equal(state.done, [1.0, 0.0])
    np.testing.assert_array_equal(state.metrics["solved"], [1.0, 0.0])
    np.testing.assert_array_equal(state.info["truncation"], 0.0)
    np.testing.assert_array_equal(state.obs, first.obs)
    assert not np.any(np.asarray(state.pipeline_state.is_terminal))


def heavier(params, factor):
    return eqx.tree_at(lambda p: p.density, params, factor * params.density)


@pytest.mark.slow
def test_randomised_worlds_move_by_their_own_numbers():
    env = BraxTask(Pendulum())
    physics = env.sys.physics
    factors = jnp.array([0.5, 2.0, 4.0])
    draws = jax.vmap(lambda factor: heavier(physics, factor))(factors)
    keys = raw_keys(2, 8)
    randomise = task_randomisation(draws)
    worlds, axes = randomise(env.sys, keys)
    assert axes.goal is None
    ratio = np.asarray(worlds.physics.density[:, 0] / physics.density[0])
    assert {round(float(r), 3) for r in ratio} == {0.5, 2.0, 4.0}

    wrapped = envs.training.wrap(
        env, episode_length=50, randomization_fn=lambda world: randomise(world, keys)
    )
    state = wrapped.reset(keys)
    action = jnp.ones((8, 2))
    moved = jax.jit(wrapped.step)(state, action)

    @jax.jit
    def one_world(key, factor):
        params = eqx.tree_at(lambda p: p.physics, env.sys, heavier(physics, factor))
        alone = BraxTask(env.task, params)
        return alone.step(alone.reset(key), action[0]).obs

    for world in range(8):
        expected = one_world(keys[world], ratio[world])
        np.testing.assert_allclose(moved.obs[world], expected, rtol=1e-5)
    # What was put in place of `sys` is taken out again.
    assert env.sys.physics.density.shape == (1,)


def test_draws_without_an_axis_of_their_own_are_refused():
    with pytest.raises(ValueError, match="draws: expected hypotheses with one leading"):
        task_randomisation(Pendulum().default_params().physics)


def test_draws_of_other_bodies_are_refused():
    world = Pendulum().default_params()
    two = jax.tree.map(lambda leaf: leaf[None], Acrobot().default_params().physics)
    with pytest.raises(ValueError, match="draws: expected densities of 1 bodies, got "):
        task_randomisation(two)(world, raw_keys(0))


@pytest.mark.parametrize("task", [None, Pendulum])
def test_what_is_no_task_is_refused(task):
    # `BraxTask` begins with this; here types would be checked before.
    with pytest.raises(ValueError, match=r"task: expected an environment, .* got "):
        _check_task(task)


@pytest.mark.slow
def test_brax_knows_tasks_once_they_are_registered():
    register_brax_envs()
    for name, make in {
        "pendulum": Pendulum,
        "cart": Cart,
        "acrobot": Acrobot,
        "living_room": LivingRoom,
    }.items():
        env = envs.get_environment(f"boomdp_{name}", num_steps=7)
        assert isinstance(env.task, make)
        assert env.task.num_steps == 7
        made = envs.create(f"boomdp_{name}", episode_length=5, batch_size=2)
        state = made.reset(jax.random.PRNGKey(0))
        assert state.obs.shape == (2, made.observation_size)


@pytest.mark.slow
def test_furniture_is_pushed_a_piece_at_a_time():
    task = LivingRoom()

    # The engine's contacts take a minute to compile: here floors are sticky instead.
    def follow(physics, state, wrench):
        return State(state.pose + 1e-3 * wrench, state.twist)

    task.advance = follow
    env = BraxTask(task)
    wrapped = envs.training.wrap(env, episode_length=5)
    first = wrapped.reset(raw_keys(3))
    preferred = jnp.array([0, 7, 11])
    action = jnp.zeros((NUM_WORLDS, env.action_size)).at[:, 1].set(1.0)
    action = action.at[jnp.arange(NUM_WORLDS), 3 + preferred].set(0.2)
    moved = wrapped.step(first, action)
    way = np.asarray(
        moved.pipeline_state.physics.pose - first.pipeline_state.physics.pose
    )
    has_moved = np.any(np.abs(way) > 1e-6, axis=2)
    np.testing.assert_array_equal(has_moved.sum(axis=1), 1)
    np.testing.assert_array_equal(np.argmax(has_moved, axis=1), preferred)
    forces = np.asarray(task.piece_actions)[preferred, :, 1].max(axis=1)
    np.testing.assert_allclose(
        way[np.arange(3), preferred, 1], 1e-3 * forces, rtol=1e-4
    )
