"""Sets of wrenches to choose from."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.envs import forces_round_circle, join_actions


def test_forces_divide_the_circle():
    actions = forces_round_circle(2, 1, 3.0, 6, torque=0.5)
    wrench = np.asarray(actions.wrench)
    assert wrench.shape == (9, 2, 3)
    np.testing.assert_array_equal(wrench[:, 0], 0.0)
    np.testing.assert_allclose(np.linalg.norm(wrench[:6, 1, :2], axis=1), 3.0)
    turn = wrench[:6, 1, 0] + 1j * wrench[:6, 1, 1]
    np.testing.assert_allclose(turn[1:] / turn[:-1], np.exp(2j * np.pi / 6))
    np.testing.assert_array_equal(wrench[6:, 1], [[0, 0, 0.5], [0, 0, -0.5], [0, 0, 0]])
    np.testing.assert_array_equal(actions[7], wrench[7])


@pytest.mark.usefixtures("no_type_checks")
@pytest.mark.parametrize(
    ("action", "error", "got"),
    [
        (-1, ValueError, "-1"),
        (4, ValueError, "4"),
        (np.int32(99), ValueError, "99"),
        (jnp.asarray(7), ValueError, "7"),
        (float("nan"), TypeError, "nan"),
        (1.0, TypeError, "1.0"),
        (True, TypeError, "True"),
        (np.array([0, 1]), TypeError, r"array\(\[0, 1\]\)"),
    ],
)
def test_what_is_no_action_is_refused(action, error, got):
    actions = forces_round_circle(1, 0, 1.0, 3)
    with pytest.raises(error, match=f"^action: expected a .*, got {got}$"):
        _ = actions[action]


def test_traced_actions_out_of_range_are_the_nearest():
    actions = forces_round_circle(1, 0, 1.0, 3)
    found = jax.jit(jax.vmap(lambda index: actions[index]))(jnp.array([-1, 1, 4]))
    np.testing.assert_array_equal(found, actions.wrench[jnp.array([0, 1, 3])])


def test_sets_are_joined_in_order():
    one, two = forces_round_circle(2, 0, 1.0, 4), forces_round_circle(2, 1, 1.0, 3)
    both = join_actions([one, two])
    assert both.num_actions == 9
    np.testing.assert_array_equal(both.wrench[5:], two.wrench)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((2, 2, 1.0), "body: expected an index below 2, got 2"),
        ((2, 0, 0.0), "force: expected positive newtons, got 0.0"),
        ((2, 0, 1.0, 0), "num_directions: expected at least 1, got 0"),
    ],
)
def test_what_cannot_be_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        forces_round_circle(*arguments)


def test_a_negative_torque_is_refused():
    with pytest.raises(ValueError, match="torque: expected newton metres of at least"):
        forces_round_circle(1, 0, 1.0, torque=-1.0)


def test_sets_of_other_scenes_are_not_joined():
    one, two = forces_round_circle(1, 0, 1.0), forces_round_circle(2, 1, 1.0)
    with pytest.raises(ValueError, match=r"same number of bodies; got \[1, 2\]"):
        join_actions([one, two])
