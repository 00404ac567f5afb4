"""Numbers between −1 and 1 reach every wrench of a task, and none beyond them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.envs import Acrobot, ActionSet, Cart, LivingRoom, Pendulum
from boomdp_jax.interop import BraxTask, continuous_actions

SIZES = {Pendulum: 2, Cart: 2, Acrobot: 1, LivingRoom: 3 + 12}


def number_of(actions, listed):
    """Numbers that ought to stand for a listed wrench, from the docstring's words."""
    wrench = np.asarray(actions.wrench)
    body = int(np.argmax(np.any(listed != 0, axis=1)))
    own, of_list = listed[body], wrench[:, body]
    force = np.linalg.norm(of_list[:, :2], axis=1).max()
    torque = np.abs(of_list[:, 2]).max()
    parts = [*(own[:2] / force)] if force else []
    parts += [own[2] / torque] if torque else []
    return body, np.array(parts)


@pytest.mark.parametrize("make", [Pendulum, Cart, LivingRoom])
def test_every_listed_wrench_is_an_action(make):
    task = make()
    filled = continuous_actions(task.actions)
    assert filled.size == SIZES[make]
    numbers = []
    for listed in np.asarray(task.actions.wrench):
        body, parts = number_of(task.actions, listed)
        preference = -np.ones(filled.num_ways)
        preference[body] = 0.3
        numbers.append([*parts, *(preference if filled.num_ways > 1 else ())])
    ours = jax.vmap(filled.wrench)(jnp.asarray(numbers))
    np.testing.assert_allclose(ours, task.actions.wrench, rtol=1e-6, atol=1e-6)


def test_a_motor_is_one_number():
    task = Acrobot()
    filled = continuous_actions(task.actions)
    assert filled.size == 1
    ours = jax.vmap(filled.wrench)(jnp.array([[-1.0], [0.0], [1.0]]))
    np.testing.assert_allclose(ours, task.actions.wrench, rtol=1e-6)


@pytest.mark.parametrize(
    "make",
    [Pendulum, Cart, Acrobot, pytest.param(LivingRoom, marks=pytest.mark.slow)],
)
def test_no_action_is_greater_than_the_listed_ones(make):
    task = make()
    filled = continuous_actions(task.actions)
    numbers = 2 * jax.random.normal(jax.random.key(0), (256, filled.size))
    ours = np.asarray(jax.vmap(filled.wrench)(numbers))
    listed = np.asarray(task.actions.wrench)
    most_force = np.linalg.norm(listed[..., :2], axis=-1).max(axis=0)
    most_torque = np.abs(listed[..., 2]).max(axis=0)
    assert np.all(np.linalg.norm(ours[..., :2], axis=-1) <= most_force + 1e-5)
    assert np.all(np.abs(ours[..., 2]) <= most_torque + 1e-5)
    # One piece at a time, where the list has it so.
    most_pushed = np.any(listed != 0, axis=2).sum(axis=1).max()
    assert np.any(ours != 0, axis=2).sum(axis=1).max() == most_pushed


def test_a_force_has_the_direction_of_its_numbers_and_grows_with_them():
    filled = continuous_actions(Cart().actions)
    numbers = jnp.array([[0.3, -0.4], [0.6, -0.8], [3.0, -4.0]])
    ours = np.asarray(jax.vmap(filled.wrench)(numbers))[:, 0, :2]
    np.testing.assert_allclose(ours[0], [9.0, -12.0], rtol=1e-6)
    np.testing.assert_allclose(ours[1], [18.0, -24.0], rtol=1e-6)
    # Beyond 1 numbers are taken for 1 before they are drawn into the disc.
    np.testing.assert_allclose(ours[2], 30.0 * np.sqrt([0.5, 0.5]) * [1, -1], rtol=1e-6)


def test_numbers_that_a_way_does_not_use_do_not_weaken_it():
    wrench = np.zeros((3, 2, 3))
    wrench[0, 0] = [2.0, 0.0, 0.0]
    wrench[1, 0] = [0.0, 0.0, 5.0]
    wrench[2, 1] = [0.0, 0.0, 3.0]
    filled = continuous_actions(ActionSet(jnp.asarray(wrench)))
    ours = filled.wrench(jnp.array([1.0, 1.0, 1.0, 0.0, 0.5]))
    np.testing.assert_allclose(ours, wrench[2], rtol=1e-6)


def test_actions_that_push_nothing_are_refused():
    with pytest.raises(ValueError, match="expected some that push a body, got none"):
        continuous_actions(ActionSet(jnp.zeros((2, 1, 3))))


def test_several_bodies_pushed_in_unlike_ways_are_refused():
    wrench = jnp.ones((2, 2, 3)).at[0, 0, 0].set(2.0)
    with pytest.raises(ValueError, match="expected wrenches on several bodies at once"):
        continuous_actions(ActionSet(wrench))


@pytest.mark.usefixtures("no_type_checks")
@pytest.mark.parametrize("shape", [(1,), (3,), (), (4, 2)])
def test_an_action_of_another_length_is_refused(shape):
    env = BraxTask(Pendulum())
    state = jax.eval_shape(env.reset, jax.random.key(0))
    with pytest.raises(ValueError, match=r"^action: expected shape \(2,\), got \("):
        jax.eval_shape(env.step, state, jnp.zeros(shape))
