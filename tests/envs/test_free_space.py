"""Maps of a room against the engine's outlines, and tables against labels."""

import jax
import numpy as np
import pytest
from scipy import ndimage

from boomdp_jax.envs import FreeSpace, pose_table, room_scene
from boomdp_jax.envs.free_space import MARGIN, distance_to
from boomdp_jax.physics import State
from boomdp_jax.physics.separation import separation
from tests.envs.namo_rooms import DOOR, poses_of, room, thing
from tests.reference.minkowski import signed_distance

IN_THE_DOOR = (*DOOR, 0.4)


def four_things():
    """Boxes and discs of several sizes."""
    outlines = ((0.3, 0.2), (0.5, 0.1), (0.35,), (0.2,))
    return room(
        things=tuple(
            thing(name=f"thing {index}", outline=outline)
            for index, outline in enumerate(outlines)
        )
    )


def gaps(one, body, poses):
    """Least distance from a body at some poses to all others but the robot [m]."""
    spec = room_scene(one)
    others = [i for i in range(spec.num_bodies) if i not in (body, one.num_things)]

    def least(pose):
        row = separation(spec.scene, State(pose, 0.0 * pose))[body]
        return row[np.array(others)].min()

    pose = np.repeat(np.asarray(spec.initial_state().pose)[None], len(poses), axis=0)
    pose[:, : one.num_things] = poses_of(one)
    pose[:, body] = poses
    return np.asarray(jax.jit(jax.vmap(least))(pose))


def table_of(one, index=0, **options):
    """Of a thing between the chambers."""
    space, poses = FreeSpace(one, **options), poses_of(one)
    labels, _ = ndimage.label(space.free(poses))
    ends = [
        labels == labels[tuple(space.grid.cell(np.array(place)))]
        for place in (one.start, one.goal)
    ]
    return space, ends, pose_table(space, index, poses, *ends)


def is_joined(space, poses, start, end):
    """By labels of the room with things at these poses."""
    free = space.free(poses)
    labels, _ = ndimage.label(free)
    return bool(np.intersect1d(labels[start & free], labels[end & free]).size)


def pose_at(table, index):
    return np.array(table.low) + np.array(table.step) * index


def test_distance_to_outlines_is_that_of_the_minkowski_difference():
    random = np.random.default_rng(0)
    for _ in range(20):
        half, pose = random.uniform(0.1, 1.0, 2), random.uniform(-3.0, 3.0, 3)
        spin = np.exp(1j * pose[2]) * (half @ [1, 1j])
        flipped = np.exp(1j * pose[2]) * (half @ [-1, 1j])
        around = np.array([spin, flipped, -spin, -flipped])
        corners = pose[:2] + np.stack([around.real, around.imag], axis=-1)
        places = pose[:2] + random.uniform(-1.5, 1.5, (8, 2))
        wanted = [signed_distance(corners, place[None]) for place in places]
        np.testing.assert_allclose(distance_to(places, half, pose), wanted, atol=1e-12)
    np.testing.assert_allclose(
        distance_to(np.array([[3.0, 4.0], [0.0, 0.5]]), (1.0,), np.zeros(3)),
        [4.0, -0.5],
    )


@pytest.mark.slow
def test_overlaps_are_those_of_the_engine():
    random = np.random.default_rng(1)
    low, high = [0.1, 0.1, -4.0], [5.9, 3.9, 4.0]
    one = four_things()
    placed = random.uniform(low, high, (4, 3))
    one = one._replace(
        things=tuple(
            each._replace(pose=tuple(pose))
            for each, pose in zip(one.things, placed.tolist(), strict=True)
        )
    )
    space = FreeSpace(one)
    for index in range(4):
        poses = random.uniform(low, high, (300, 3))
        gap = gaps(one, index, poses)
        found = space.overlaps(index, poses, placed)
        np.testing.assert_array_equal(found, gap < 0.0)
        assert 20 < found.sum() < 280


def test_free_cells_are_those_where_the_robot_has_room():
    one = room(thing(pose=IN_THE_DOOR))
    space = FreeSpace(one)
    places = space.places.reshape(-1, 2)
    spec = room_scene(one)
    pose = np.repeat(np.asarray(spec.initial_state().pose)[None], len(places), axis=0)
    pose[:, 1, :2] = places

    def least(pose):
        return separation(spec.scene, State(pose, 0.0 * pose))[1].min()

    gap = np.asarray(jax.jit(jax.vmap(least))(pose)).reshape(space.grid.shape)
    free = space.free(poses_of(one))
    np.testing.assert_array_equal(free, gap > MARGIN)
    without = space.free(poses_of(one), without=0)
    np.testing.assert_array_equal(free, without & ~space.closed_by(0, poses_of(one)[0]))
    assert (without & ~free).sum() > 20


@pytest.mark.parametrize("outline", [(0.3, 0.25), (0.35,)])
def test_what_a_pose_opens_is_what_labels_say_with_the_thing_there(outline):
    one = room(thing(outline=outline, pose=IN_THE_DOOR))
    space, (start, end), table = table_of(one)
    blocked = space.overlaps(
        0,
        np.array([pose_at(table, index) for index in np.ndindex(table.blocked.shape)]),
        poses_of(one),
    )
    np.testing.assert_array_equal(table.blocked, blocked.reshape(table.blocked.shape))
    random = np.random.default_rng(0)
    found = []
    for _ in range(150):
        index = tuple(int(random.integers(n)) for n in table.opened.shape)
        joined = is_joined(space, pose_at(table, index)[None], start, end)
        assert table.opened[index] == (joined and not table.blocked[index])
        found.append(table.opened[index])
    assert 20 < sum(found) < 130


def test_distance_ahead_is_that_to_the_nearest_opened_pose_round_the_circle():
    one = room(thing(pose=IN_THE_DOOR))
    *_, table = table_of(one)
    gyration = np.sqrt((0.3**2 + 0.25**2) / 3.0)
    num = table.opened.shape[2]
    opened = np.argwhere(table.opened)
    random = np.random.default_rng(0)
    for _ in range(40):
        index = np.array([random.integers(n) for n in table.opened.shape])
        steps = np.abs(opened - index)
        steps[:, 2] = np.minimum(steps[:, 2], num - steps[:, 2])
        lengths = np.array([*table.step[:2], table.step[2] * gyration])
        wanted = np.linalg.norm(steps * lengths, axis=1).min()
        assert abs(table.ahead[tuple(index)] - wanted) < 1e-9


def test_nothing_ahead_where_no_pose_opens_the_way():
    one = room(thing(pose=(1.0, 1.0, 0.0)), goal=(5.0, 2.0))
    space, poses = FreeSpace(one), poses_of(one)
    nowhere = np.zeros(space.grid.shape, bool)
    table = pose_table(space, 0, poses, space.free(poses), nowhere)
    assert not table.opened.any()
    assert np.all(table.ahead == np.inf)


@pytest.mark.parametrize("size", [(12.0, 10.0), (10.0, 12.0)])
def test_rooms_of_more_cells_than_a_word_has_bits_both_ways_have_wider_ones(size):
    x, y = size
    walls = (
        (-0.2, 0.0, 0.0, y),
        (-0.2, -0.2, x + 0.2, 0.0),
        (x, 0.0, x + 0.2, y),
        (-0.2, y, x + 0.2, y + 0.2),
        (4.0, 0.0, 4.2, 4.5),
        (4.0, 5.5, 4.2, y),
    )
    one = room(
        thing(pose=(4.1, 5.0, 0.0)), walls=walls, start=(2.0, 5.0), goal=(7.0, 5.0)
    )
    space, (start, end), table = table_of(one)
    assert min(space.grid.shape) <= 64 < max(space.grid.shape)
    np.testing.assert_allclose(space.places[-1, -1], size, atol=space.grid.spacing)
    assert not (start & end).any()
    assert table.opened.any()
    random = np.random.default_rng(0)
    for _ in range(30):
        index = tuple(int(random.integers(n)) for n in table.opened.shape)
        joined = is_joined(space, pose_at(table, index)[None], start, end)
        assert table.opened[index] == (joined and not table.blocked[index])
