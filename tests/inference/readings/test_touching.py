"""Which bodies may have touched where angles, or bodies, are not read at all times."""

import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.inference.readings.touching import find_touching
from boomdp_jax.physics import scene_spec_from_dict
from tests.inference.two_discs import DT

GIVEN = {"friction": 0.4, "restitution": 0.3}


def crossing(*, outline=None, num=12):
    """Poses of a disc and of what it runs into, `[instant, 2, 3]`, and the scene."""
    outline = outline or {"type": "circle", "radius": 0.1}
    shapes = [{"type": "circle", "radius": 0.1}, outline]
    bodies = [
        {"name": name, "shape": shape, "contact": GIVEN}
        for name, shape in zip("ab", shapes, strict=True)
    ]
    spec = scene_spec_from_dict(
        {"schema": "planar-scene-1", "dt": DT, "bodies": bodies}, source="test"
    )
    pose = np.zeros((num, 2, 3))
    pose[:, 0, 0] = np.linspace(0.0, 0.35, num)
    pose[:, 1, 0] = 0.5
    if outline["type"] == "circle":
        # They spin, which is nothing to where their outlines are.
        pose[..., 2] = np.linspace(0.0, 40.0, num)[:, None]
    return spec, pose


def touching(spec, pose, **more):
    state = np.full((*pose.shape[:2], 6), np.nan)
    state[..., :3] = pose
    action = np.zeros((len(pose) - 1, *pose.shape[1:]))
    history = make_history(state[:-1], action, state[1:], DT, **more)
    return find_touching(spec, history)


def touch(spec, pose):
    return bool(touching(spec, pose).pairs[0, 1])


@pytest.mark.parametrize("which", ["never", "in turn", "of one", "bodies in turn"])
def test_discs_touch_whether_or_not_their_angles_are_read(which):
    spec, pose = crossing()
    near, far = np.array(pose), np.array(pose)
    far[:, 1, 0] += 0.1
    for each, expected in ((near, True), (far, False)):
        if which == "never":
            each[..., 2] = np.nan
        elif which == "in turn":
            each[::2, :, 2] = np.nan
            each[1::2, :, :2] = np.nan
        elif which == "of one":
            each[:, 0, 2] = np.nan
        else:
            each[::2, 0] = np.nan
            each[1::2, 1] = np.nan
        assert touch(spec, each) == expected


def test_an_outline_whose_angle_is_unread_is_taken_for_the_circle_round_it():
    """A long box across the way of a disc: which of its sides is unknown."""
    box = {"type": "box", "half_extents": [0.02, 0.2]}
    spec, pose = crossing(outline=box)
    pose[:, 1, 0] = 0.6
    assert not touch(spec, pose)
    some = np.array(pose)
    some[:6, 1, 2] = np.nan
    # Where it is near its angle was read.
    assert not touch(spec, some)
    pose[:, 1, 2] = np.nan
    assert touch(spec, pose)
    pose[:, 1, 0] = 0.8
    assert not touch(spec, pose)


BOX = {"type": "box", "half_extents": [0.1, 0.1]}


@pytest.mark.parametrize("outline", [None, BOX])
def test_rows_near_a_touch_are_told_and_those_before_them(outline):
    """The gap of 0.3 m closes by 32 mm a row: in the tenth they meet, noise or not."""
    spec, pose = crossing(outline=outline)
    near = touching(spec, pose).near_rows((0, 1), 20)
    expected = np.zeros(20, bool)
    # And the row before the one that is next to that one, by how far it may go.
    expected[7:11] = True
    np.testing.assert_array_equal(near, expected)


def test_rows_in_which_a_body_was_not_read_may_hide_a_touch():
    spec, pose = crossing(outline=BOX)
    pose[3, 1, 2] = np.nan
    near = touching(spec, pose).near_rows((0, 1), 11)
    # The two rows that it is an end of, and those beside them.
    np.testing.assert_array_equal(np.flatnonzero(near), [1, 2, 3, 4, 7, 8, 9, 10])


def test_a_touch_says_nothing_of_the_run_before_it():
    spec, pose = crossing()
    episode = np.array([0] * 8 + [1] * 3)
    near = touching(spec, pose, episode=episode).near_rows((0, 1), 11)
    np.testing.assert_array_equal(np.flatnonzero(near), [8, 9, 10])


@pytest.mark.parametrize("dt", [1 / 60, 1 / 20])
@pytest.mark.parametrize("speed", [0.5, 1.5, 3.0])
def test_rows_in_which_a_disc_bounces_off_a_wall_and_comes_back_are_told(dt, speed):
    """Between two walls, every other row may begin and end as far from one."""
    contact = {"friction": 0.0, "restitution": 0.8}
    wall = {"type": "box", "half_extents": [0.1, 2.0]}
    ball = {"name": "ball", "shape": {"type": "circle", "radius": 0.1}}
    walls = [
        {"name": name, "shape": wall, "pose": [x, 0.0, 0.0], "static": True}
        for name, x in (("left", -1.2), ("right", 1.2))
    ]
    spec = scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": dt,
            "bodies": [{**body, "contact": contact} for body in (ball, *walls)],
        },
        source="test",
    )
    num, rng = 160, np.random.default_rng(0)
    place, velocity, places, hits = rng.uniform(-0.9, 0.9), speed, [], []
    for _ in range(num):
        places.append(place)
        left, hits_now = dt, False
        while velocity and (to_go := (np.sign(velocity) - place) / velocity) < left:
            # The face of each wall is 1.1 m from the middle.
            left, place, hits_now = left - to_go, np.sign(velocity), True
            velocity *= -0.8
        place += left * velocity
        hits.append(hits_now)
    pose = np.zeros((num, 3, 3))
    pose[:, 0, 0] = places + 1e-3 * rng.standard_normal(num)
    pose[:, 1:, 0] = [-1.2, 1.2]
    near = touching(spec, pose).near_rows((0,), num - 1)
    assert np.any(hits[:-1])
    assert np.all(near[np.array(hits[:-1])])
    if speed * dt < 0.02:
        assert near.mean() < 0.5
