"""Every task's face: episodes that begin, run and end, alone and in batches."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.envs import Acrobot, Cart, LivingRoom, Pendulum

TASKS = {"pendulum": Pendulum, "cart": Cart, "acrobot": Acrobot}


@pytest.fixture(scope="module", params=TASKS)
def task(request):
    return TASKS[request.param](num_steps=5)


def episode(task, params, key, actions):
    """Rewards, ends and last state of an episode in one scan."""

    def one(state, action):
        _, state, reward, done, info = task.step(None, state, action, params)
        return state, (reward, done, info["truncated"])

    _, state = task.reset(key, params)
    return jax.lax.scan(one, state, actions)


def test_an_episode_ends_when_its_time_is_up(task):
    actions = jnp.zeros(5, jnp.int32)
    params = task.default_params()
    state, (reward, done, truncated) = jax.jit(
        lambda key: episode(task, params, key, actions)
    )(jax.random.key(0))
    np.testing.assert_array_equal(done, [False] * 4 + [True])
    np.testing.assert_array_equal(truncated, done)
    assert int(state.time) == 5
    assert np.all(np.asarray(reward) < 0)


@pytest.mark.slow
def test_a_batch_of_worlds_is_a_loop_over_them(task):
    params = task.default_params()
    keys = jax.random.split(jax.random.key(1), 3)
    actions = jnp.arange(5) % task.num_actions
    scale = jnp.array([1.0, 2.0, 0.5])

    def run(key, scale):
        density = scale * params.physics.density
        heavier = eqx.tree_at(lambda p: p.physics.density, params, density)
        return episode(task, heavier, key, actions)

    batch = jax.jit(jax.vmap(run))(keys, scale)
    alone = [jax.jit(run)(key, part) for key, part in zip(keys, scale, strict=True)]
    for whole, parts in zip(
        jax.tree.leaves(batch),
        zip(*(jax.tree.leaves(one) for one in alone), strict=True),
        strict=True,
    ):
        np.testing.assert_allclose(whole, np.stack(parts), rtol=1e-9, atol=1e-9)
    # Worlds of other masses move otherwise.
    assert np.ptp(np.asarray(batch[1][0])[:, -1]) > 1e-6


def test_starts_differ_and_are_drawn_by_the_key(task):
    params = task.default_params()
    first, _ = task.reset(jax.random.key(3), params)
    again, _ = task.reset(jax.random.key(3), params)
    other, _ = task.reset(jax.random.key(4), params)
    np.testing.assert_array_equal(first, again)
    assert np.max(np.abs(np.asarray(first - other))) > 1e-3


def test_tasks_are_hashed_by_identity(task):
    """So that `jax.jit(task.step)` compiles once."""
    assert hash(task) == hash(task)
    assert task != TASKS[task.name](num_steps=5)


def test_a_scene_hides_what_is_to_be_found(task):
    assert all(body.density is None for body in task.spec.bodies)
    assert task.spec.unknown
    assert not np.any(np.isnan(np.asarray(task.default_params().physics.density)))


@pytest.mark.usefixtures("no_type_checks")
@pytest.mark.parametrize("make", [*TASKS.values(), LivingRoom])
def test_an_episode_has_a_whole_number_of_steps(make):
    for num_steps in (0, -5, 1.5, True):
        with pytest.raises(ValueError, match=r"^num_steps: expected .*at least 1, got"):
            make(num_steps=num_steps)
