"""The cart in its room: stopped by walls, free elsewhere, done at the goal."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

from boomdp_jax.envs import Cart, stopped_at_walls, walls_between
from boomdp_jax.envs.cart import (
    CART_OUTLINE,
    GOAL,
    GOAL_RADIUS,
    ROOM,
    START,
    cart_scene,
)
from boomdp_jax.envs.walls import outline_of, wall_separation
from boomdp_jax.physics import State, step

OUTLINE = outline_of(np.array(CART_OUTLINE))


def overlap(wall, pose):
    """Whether a box and the cart have a point in common: a linear programme."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    corners = np.array(CART_OUTLINE) @ np.array([[c, s], [-s, c]]) + pose[:2]
    along = np.roll(corners, -1, axis=0) - corners
    normal = np.stack([along[:, 1], -along[:, 0]], 1)
    found = linprog(
        np.zeros(2),
        A_ub=normal,
        b_ub=np.sum(normal * corners, axis=1),
        bounds=list(zip(wall[:2], wall[2:], strict=True)),
    )
    return found.status == 0


def test_overlap_is_found_as_a_linear_programme_finds_it():
    rng = np.random.default_rng(0)
    wall = np.array([-0.4, -0.7, 0.3, 0.2])
    poses = rng.uniform([-1.5, -1.5, -4.0], [1.5, 1.5, 4.0], (300, 3))
    gaps = jax.vmap(lambda p: wall_separation(walls_between(wall[None]), OUTLINE, p))(
        jnp.asarray(poses)
    )
    truth = [overlap(wall, pose) for pose in poses]
    assert 50 < sum(truth) < 250
    np.testing.assert_array_equal(np.asarray(gaps) < 0, truth)


def test_depth_is_the_shortest_push_out_of_a_half_plane():
    far = np.array([[-50.0, -50.0, 0.0, 50.0]])
    for angle in (0.0, 0.3, 2.0):
        c, s = np.cos(angle), np.sin(angle)
        reach = np.min((np.array(CART_OUTLINE) @ np.array([[c, s], [-s, c]]))[:, 0])
        pose = jnp.array([0.2, 1.0, angle])
        gap = wall_separation(walls_between(far), OUTLINE, pose)
        np.testing.assert_allclose(gap, 0.2 + reach, atol=1e-12)


def drive(task, seed, num_steps):
    params = task.default_params()
    reset_key, action_key = jax.random.split(jax.random.key(seed))
    actions = jax.random.randint(action_key, (num_steps // 5,), 0, task.num_actions)
    _, state = task.reset(reset_key, params)

    def one(state, action):
        before = state
        _, state, reward, _, _ = task.step(None, state, action, params)
        return state, (before.physics, task.actions[action], state.physics, reward)

    return jax.lax.scan(one, state, jnp.repeat(actions, 5))[1]


@pytest.fixture(scope="module")
def rides():
    task = Cart()
    run = jax.jit(jax.vmap(lambda seed: drive(task, seed, 100)))
    return task, run(jnp.arange(12))


@pytest.mark.slow
def test_the_cart_is_never_in_a_wall(rides):
    task, (_, _, after, _) = rides
    poses = after.pose.reshape(-1, 3)
    gap = jax.vmap(lambda p: wall_separation(task.walls, task.outline, p))(poses)
    assert float(jnp.min(gap)) >= 0.0


@pytest.mark.slow
def test_it_was_stopped_or_moved_as_the_engine_says(rides):
    task, (before, wrench, after, _) = rides
    spec = cart_scene(is_known=True)

    def free(state, wrench):
        return step(spec.scene, spec.params(), state, wrench)[0]

    expected = jax.jit(jax.vmap(jax.vmap(free)))(before, wrench)
    error = np.max(np.abs(expected.pose - after.pose), axis=(-1, -2))
    is_stopped = np.all(np.asarray(after.twist) == 0, axis=(-1, -2))
    assert np.all(error[~is_stopped] < 1e-12)
    assert 0.02 < np.mean(is_stopped & (error > 1e-6)) < 0.9
    # Whoever was stopped was near a wall, which `moved_freely` knows.
    knows = jax.vmap(jax.vmap(task.moved_freely))(before, after)[..., 0]
    # Enough is left to learn from, so that the next line says something.
    num_kept = np.sum(np.asarray(knows) & ~is_stopped)
    assert num_kept > 0.1 * is_stopped.size
    was_short = error > 1e-6
    assert not np.any(np.asarray(knows)[was_short])


def test_a_wall_stops_a_step_that_would_jump_over_it():
    wall = walls_between(np.array([[2.0, -5.0, 2.1, 5.0]]))
    before = State(jnp.zeros((1, 3)), jnp.ones((1, 3)))
    after = State(jnp.array([[2.4, 0.0, 0.0]]), jnp.ones((1, 3)))
    end = stopped_at_walls(wall, OUTLINE, before, after)
    np.testing.assert_allclose(end.pose[0], [1.2, 0.0, 0.0])
    np.testing.assert_array_equal(end.twist, 0.0)


@pytest.mark.slow
def test_the_goal_ends_all_cost():
    task = Cart()
    params = task.default_params()
    near = jnp.array([[GOAL[0] - 0.9 * GOAL_RADIUS, GOAL[1], 0.0]])
    params = eqx.tree_at(
        lambda p: (p.start, p.start_spread), params, (near, jnp.zeros((1, 3)))
    )
    _, state = task.reset(jax.random.key(0), params)
    _, after, reward, done, info = task.step(None, state, 0, params)
    assert bool(state.is_terminal)
    assert bool(done)
    assert not bool(info["truncated"])
    assert float(reward) == 0.0
    np.testing.assert_array_equal(after.physics.pose, state.physics.pose)


def test_the_way_is_as_long_as_in_the_papers():
    """353 pixels straight; the reward of the first step was −370 of the same."""
    task = Cart()
    params = task.default_params()
    straight = np.linalg.norm(np.asarray(params.start[0, :2]) - GOAL)
    np.testing.assert_allclose(straight, 3.53, atol=0.01)
    # The straight way leads through the middle wall.
    assert any(
        overlap(np.array(wall), np.array([x, 1.36, 0.0]))
        for wall in ROOM
        for x in np.linspace(START[0], GOAL[0], 30)
    )


def test_starts_are_clear_of_walls():
    task = Cart()
    params = task.default_params()
    keys = jax.random.split(jax.random.key(0), 256)
    states = jax.vmap(lambda key: task.start(key, params))(keys)
    gap = jax.vmap(lambda s: wall_separation(task.walls, task.outline, s.pose[0]))(
        states
    )
    assert float(jnp.min(gap)) > 0.0
    assert np.ptp(np.asarray(states.pose[:, 0, 2])) > 6.0


def test_a_wall_without_inside_is_refused():
    with pytest.raises(ValueError, match=r"walls\[1\]: expected greatest x and y"):
        walls_between(np.array([[0.0, 0.0, 1.0, 1.0], [0.0, 1.0, 1.0, 0.5]]))


def test_what_is_seen_round_the_cart_are_its_walls():
    task = Cart(num_steps=1)
    scene, pose = task.surroundings
    assert scene.num_bodies == 1 + len(ROOM) == 1 + len(pose)
    np.testing.assert_array_equal(
        np.asarray(scene.is_static), [False] + len(ROOM) * [True]
    )
    np.testing.assert_allclose(scene.vertices[0], task.scene.vertices[0], atol=1e-6)
    corners = np.asarray(scene.vertices[1:, :4]) + np.asarray(pose)[:, None, :2]
    boxes = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
    np.testing.assert_allclose(boxes, ROOM, atol=1e-6)
