"""The flat: what is where, and that its world is what its pieces are told to be."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.envs import LivingRoom
from boomdp_jax.envs.blocking import box_separation
from boomdp_jax.envs.furniture import PIECES
from boomdp_jax.envs.living_room import GOAL_RADIUS
from boomdp_jax.physics import State, step

TASK = LivingRoom(num_steps=5)
PARAMS = TASK.default_params()
NUM = TASK.num_pieces


def gaps(pose):
    """Of each piece to whatever is nearest."""
    separation = jax.vmap(
        lambda body: box_separation(
            TASK.obstacles(body, pose), TASK.half_extents[body], pose[body]
        )
    )
    return np.asarray(separation(jnp.arange(NUM)))


def test_it_has_what_the_paper_shows():
    names = [piece.name for piece in PIECES]
    assert NUM >= 11
    for word in ("table", "chair", "couch", "bed", "desk", "piano"):
        assert any(word in name for name in names)
    wheeled = {piece.name for piece in PIECES if piece.wheels is not None}
    assert wheeled == {"dining table", "desk"}
    assert [piece.name for piece in PIECES if piece.pin] == ["kitchen table"]
    # The published first reward is 63 pixels.
    cost = -TASK.reward(*still(PARAMS.start), PARAMS.goal)
    assert 0.5 < float(cost) < 0.75


def still(pose):
    """At rest, before and after."""
    state = State(pose, jnp.zeros_like(pose))
    return state, jnp.zeros_like(pose), state


@pytest.mark.slow
def test_pieces_are_clear_of_each_other_where_they_start_and_where_they_belong():
    for seed in range(5):
        start = TASK.start(jax.random.key(seed), PARAMS)
        assert np.min(gaps(start.pose)) > 0
    # Whatever way they are turned: only places count.
    for angle in np.linspace(0, np.pi, 7):
        pose = PARAMS.goal.at[:NUM, 2].set(angle)
        assert np.min(gaps(pose)) > 0


def test_the_pinned_table_can_get_to_its_place():
    (table,) = (piece for piece in PIECES if piece.pin)
    pin = np.add(table.start, table.pin)
    arm = np.hypot(*(np.array(table.goal) - pin))
    np.testing.assert_allclose(arm, np.hypot(*table.pin), atol=GOAL_RADIUS / 2)


def test_cost_is_the_mean_distance_of_those_not_in_place():
    pose = PARAMS.goal.at[2, 0].add(0.5).at[4, 1].add(-0.9 * GOAL_RADIUS)
    assert not bool(TASK.is_solved(State(pose, 0 * pose), PARAMS.goal))
    reward = TASK.reward(*still(pose), PARAMS.goal)
    np.testing.assert_allclose(reward, -0.5 / NUM, rtol=1e-6)
    solved = PARAMS.goal.at[:NUM, 0].add(0.9 * GOAL_RADIUS)
    assert bool(TASK.is_solved(State(solved, 0 * solved), PARAMS.goal))


def test_each_action_pushes_one_piece_or_none():
    wrench = np.asarray(TASK.actions.wrench)
    is_pushed = np.any(wrench != 0, axis=2)
    np.testing.assert_array_equal(is_pushed[:-1].sum(axis=1), 1)
    assert not is_pushed[-1].any()
    own = np.asarray(TASK.piece_actions)
    for body in range(NUM):
        for index in range(own.shape[1]):
            action = wrench[int(TASK.action_of(jnp.asarray(body), jnp.asarray(index)))]
            np.testing.assert_array_equal(action[body], own[body, index])


def test_a_piece_alone_has_the_rooms_numbers():
    numbers = TASK.lone_params(PARAMS.physics)
    for body, piece in enumerate(PIECES):
        lone = jax.tree.map(lambda leaf, b=body: leaf[b], numbers)
        mass = piece.density * 4 * np.prod(piece.half_extents)
        np.testing.assert_allclose(lone.density, [piece.density])
        np.testing.assert_allclose(lone.ground.viscous[0, 0], piece.rate * mass)
        assert bool(lone.revolute.active[0]) == (piece.pin is not None)
        is_wheeled = bool(jnp.any(lone.wheel.active))
        assert is_wheeled == (piece.wheels is not None)


@pytest.fixture(scope="module")
def world():
    return jax.jit(lambda state, wrench: TASK.advance(PARAMS.physics, state, wrench))


@pytest.mark.slow
def test_in_the_open_the_room_moves_a_piece_as_it_moves_alone(world):
    numbers, scenes = TASK.lone_params(PARAMS.physics), TASK.lone_scenes()
    state = State(PARAMS.start, jnp.zeros_like(PARAMS.start))
    num_free = 0
    for action in range(3, TASK.num_actions, 7):
        body = min(action // 10, NUM - 1)
        moved = world(state, TASK.actions[action])
        if not bool(TASK.moved_freely(state, moved)[body]):
            continue
        num_free += 1
        scene, lone = jax.tree.map(lambda leaf, b=body: leaf[b], (scenes, numbers))
        alone, _ = step(
            scene,
            lone,
            State(state.pose[body][None], state.twist[body][None]),
            TASK.actions[action][body][None],
        )
        np.testing.assert_allclose(moved.pose[body], alone.pose[0], atol=3e-4)
    assert num_free > 8


@pytest.mark.slow
def test_a_piece_shoves_another_one_and_walls_hold(world):
    pose = PARAMS.start.at[4].set(jnp.array([3.22, 4.9, 0.0]))
    state = State(pose, jnp.zeros_like(pose))
    # The first dining chair is pushed along y, at the second one's back.
    chair = State(pose.at[5].set(jnp.array([3.22, 5.4, 0.0])), state.twist)
    up = TASK.actions[4 * 10 + 2]
    moved = chair
    for _ in range(4):
        moved = world(moved, up)
    assert float(moved.pose[5, 1]) > 5.42
    assert np.min(gaps(moved.pose)) > -0.02
    for _ in range(80):
        moved = world(moved, up)
    assert float(moved.pose[5, 1]) < 8.5
    assert np.min(gaps(moved.pose)) > -0.05
