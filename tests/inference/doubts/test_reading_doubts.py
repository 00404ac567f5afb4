"""Doubts that readings alone give: senses of angles, known joints, too much noise."""

import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.inference.doubts.angle_sense import angle_sense_reasons
from boomdp_jax.inference.doubts.known_joints import known_joint_reasons
from boomdp_jax.inference.doubts.noise_doubts import noise_reasons
from boomdp_jax.inference.readings.reading_sequence import readings_in_order, scatter
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict

DT, NOISE = 0.05, np.array([1e-3, 1e-3, 2e-3])


BOX, DISC = {"type": "box", "half_extents": [0.3, 0.2]}, {"type": "circle", "radius": 9}


def scene(*constraints: dict, num: int = 1, shape: dict = BOX) -> SceneSpec:
    """Bodies that are alike, and what is known of them."""
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": DT,
            "bodies": [{"name": f"box{i}", "shape": shape} for i in range(num)],
            "constraints": list(constraints),
            "unknown": {"revolute": 1, "wheel": 1},
        },
        source="test",
    )


def beside_a_wall() -> SceneSpec:
    """A box that may touch something."""
    contact = {"contact": {"friction": 0.5, "restitution": 0.0}}
    box = {"name": "box0", "shape": BOX, **contact}
    wall = {"name": "wall", "shape": BOX, "static": True, "pose": [5, 0, 0], **contact}
    scene = {"schema": "planar-scene-1", "dt": DT, "bodies": [box, wall]}
    return scene_spec_from_dict(scene | {"unknown": {"ground": 1}}, source="test")


def swing(rng: np.random.Generator, num: int) -> np.ndarray:
    """Angles of something that is turned to and fro, smooth at every reading."""
    time = DT * np.arange(num)
    pace, phase = rng.uniform(0.5, 2.0, 3), rng.uniform(0.0, 6.0, 3)
    return np.sum(0.6 * np.sin(np.outer(time, pace) + phase), axis=1)


def pinned(angle: np.ndarray, anchor=(0.2, 0.1), place=(0.5, -0.3)) -> np.ndarray:
    """Poses of a body whose anchor stays, closed form."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = anchor
    away = np.column_stack([cos * x - sin * y, sin * x + cos * y])
    return np.column_stack([place - away, angle])


def rolling(rng: np.random.Generator, angle: np.ndarray) -> np.ndarray:
    """Poses of a body that only moves along its own x, in a thousand parts a step."""
    fine = np.interp(
        np.arange(1000 * (len(angle) - 1) + 1) / 1000, np.arange(len(angle)), angle
    )
    speed = 0.3 + 0.2 * np.sin(np.arange(len(fine)) * DT / 1000 * rng.uniform(1, 2))
    step = speed * DT / 1000
    path = np.cumsum(np.column_stack([np.cos(fine), np.sin(fine)]) * step[:, None], 0)
    return np.column_stack([path[::1000], angle])


def free(rng: np.random.Generator, angle: np.ndarray) -> np.ndarray:
    """Poses that have nothing to do with the angle."""
    other = np.column_stack([swing(rng, len(angle)), swing(rng, len(angle))])
    return np.column_stack([other, angle])


def history_of(rng, *poses: np.ndarray, noise=NOISE, capacity=None):
    """Readings of poses alone, of one body or several side by side."""
    pose = np.stack(poses, axis=1) + noise * rng.normal(size=(len(poses[0]), 1, 3))
    state = np.full((*pose.shape[:2], 6), np.nan)
    state[..., :3] = pose
    push = np.zeros((len(pose) - 1, len(poses), 3))
    return make_history(state[:-1], push, state[1:], DT, capacity=capacity)


SENSES = {"clockwise": -1.0, "degrees": 180.0 / np.pi, "both": -180.0 / np.pi}
WORDS = {
    "clockwise": "counted the other way round; expected counterclockwise",
    "degrees": "in degrees; expected radians",
    "both": "in degrees and counted the other way round",
}


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("sense", list(SENSES))
@pytest.mark.parametrize("kind", ["pin", "wheel"])
def test_angles_that_are_read_otherwise_are_named(kind: str, sense: str, seed: int):
    """With noise; wrapped, where they are degrees, to within a turn as well."""
    rng = np.random.default_rng([1, seed])
    angle = 1.5 * swing(rng, 81)
    poses = pinned(angle) if kind == "pin" else rolling(rng, angle)
    spec = scene()
    assert angle_sense_reasons(spec, history_of(rng, poses)) == []
    poses = poses + NOISE * rng.normal(size=poses.shape)
    poses[:, 2] *= SENSES[sense]
    for wraps in (False, True):
        if wraps and sense != "clockwise":
            poses[:, 2] = (poses[:, 2] + 180.0) % 360.0 - 180.0
        (reason,) = angle_sense_reasons(spec, history_of(rng, poses, noise=0.0))
        assert reason.startswith(
            f"box0: its angles look as if they were {WORDS[sense]}"
        )


def test_free_bodies_say_nothing_of_their_angles():
    """Of 300; and neither do short recordings or bodies that hardly turn."""
    spec, named = scene(), 0
    for seed in range(300):
        rng = np.random.default_rng([2, seed])
        history = history_of(rng, free(rng, swing(rng, 81)))
        named += len(angle_sense_reasons(spec, history))
    assert named == 0
    rng = np.random.default_rng(3)
    poses = pinned(swing(rng, 40))
    poses[:, 2] *= -1.0
    assert angle_sense_reasons(spec, history_of(rng, poses)) == []
    poses = pinned(0.05 * swing(rng, 200))
    poses[:, 2] *= -1.0
    assert angle_sense_reasons(spec, history_of(rng, poses, noise=0.0)) == []


def joint(kind: str, partner: str, **numbers) -> dict:
    """A known one of the first box."""
    ends = {"anchor_a": [0.2, 0.1], "anchor_b": [0.5, -0.3]}
    return {"type": kind, "a": "box0", "b": partner, **ends, **numbers}


def test_known_pins_are_held_against_readings():
    rng = np.random.default_rng(4)
    history = history_of(rng, pinned(swing(rng, 81)))
    right = scene(joint("revolute", "world"))
    assert known_joint_reasons(right, history) == []
    wrong = scene(joint("revolute", "world", anchor_a=[0.21, 0.1]))
    (reason,) = known_joint_reasons(wrong, history)
    # The median of 1 cm in a known direction and noise of 1 mm.
    assert "box0: its readings are 0.0099 m off its known pin to the world" in reason
    # What is to be inferred cannot be wrong.
    open_ = scene(joint("revolute", "world", anchor_a=[None, None]))
    assert known_joint_reasons(open_, history) == []


def test_known_rods_guides_and_welds_are_held_against_readings():
    """Each right, and with one number that is not."""
    rng = np.random.default_rng(5)
    angle = swing(rng, 81)
    box = pinned(angle)
    tip = rolling(rng, swing(rng, 81))
    cases = [
        # A rod of no moving end to the world.
        ("distance", "world", {"anchor_b": [0.5, 0.7], "length": 1.0}, {"length": 1.1}),
        ("prismatic", "world", {"axis": 0.4}, {}),
    ]
    for kind, partner, numbers, change in cases:
        if kind == "prismatic":
            along = swing(rng, 81)
            poses = np.column_stack(
                [0.5 + along * np.cos(0.4), -0.3 + along * np.sin(0.4), 0 * along]
            )
            numbers, change = numbers | {"anchor_a": [0, 0]}, {"axis": 0.5}
        else:
            poses = box
        history = history_of(rng, poses)
        spec = scene(joint(kind, partner, **numbers))
        assert known_joint_reasons(spec, history) == []
        spec = scene(joint(kind, partner, **numbers | change))
        (reason,) = known_joint_reasons(spec, history)
        assert " m off its known " in reason
    # The second box is turned by 0.6 rad against the first: theta_a - theta_b.
    turn = np.column_stack([np.cos(tip[:, 2]), np.sin(tip[:, 2])])
    other = np.column_stack([tip[:, :2] + 0.5 * turn, tip[:, 2] - 0.6])
    history = history_of(rng, tip, other)
    weld = {"anchor_a": [0.5, 0.0], "anchor_b": [0.0, 0.0]}
    spec = scene(joint("weld", "box1", **weld, angle=0.6), num=2)
    assert known_joint_reasons(spec, history) == []
    spec = scene(joint("weld", "box1", **weld, angle=-0.6), num=2)
    (reason,) = known_joint_reasons(spec, history)
    assert reason.startswith(
        "box0: its readings are 1.2 rad off its known weld to 'box1'"
    )


def test_noise_above_what_readings_scatter_by_is_named():
    rng = np.random.default_rng(6)
    history = history_of(rng, pinned(swing(rng, 81)), noise=NOISE)
    own = np.array([1e-3, 2e-3, 1.0, 1.0])
    kicks = np.full((4, 1, 2), 1e-3)

    def reasons(scale, shape=BOX, prior=1e-3):
        known = np.tile(scale, (4, 1, 1)), np.full((4, 1, 4), prior), kicks
        return noise_reasons(scene(shape=shape), history, *known)

    assert reasons(own) == []
    assert reasons(2.0 * own) == []
    none = history_of(rng, np.zeros((1, 3)), capacity=4)
    known = np.tile(100.0 * own, (4, 1, 1)), np.full((4, 1, 4), 1e-3), kicks
    assert noise_reasons(scene(), none, *known) == []
    (reason,) = reasons(own * [7.0, 1.0, 1.0, 1.0])
    assert "readings of its position are taken to be off by 0.007 m" in reason
    (reason,) = reasons(own * [1.0, 10.0, 1.0, 1.0])
    assert "readings of its angle" in reason
    # What the prior says is all that is known of bodies whose readings are left out.
    assert reasons(own * [7.0, 1.0, 1.0, 1.0], prior=5e-3) == []
    assert len(reasons(own * [7.0, 1.0, 1.0, 1.0], prior=4e-3)) == 1
    # Whatever readings scatter by, as where they are millimetres or degrees.
    kicks[..., 1] = 19.0
    (reason,) = reasons(own)
    assert "its angle is taken to be off or to change by chance by 0.95 rad" in reason
    kicks[...] = [209.0, 1e-3]
    (reason,) = reasons(own)
    assert "its position is taken to be off or to change by chance by 10 m" in reason
    # A disc of 9 m.
    kicks[..., 0] = 1700.0
    assert reasons(own, DISC) == []
    kicks[..., 0] = 1900.0
    assert len(reasons(own, DISC)) == 1
    kicks = None
    assert reasons(own) == []


def test_what_is_rounded_or_finer_along_one_axis_is_no_alarm():
    """Rounded to 1 degree and 5 mm; noise of 20 mm along x and 0.2 mm along y."""
    rng = np.random.default_rng(8)
    poses = pinned(0.3 * swing(rng, 81))
    known = scene(joint("revolute", "world"))
    rounded = poses.copy()
    rounded[:, :2] = 5e-3 * np.round(poses[:, :2] / 5e-3)
    rounded[:, 2] = np.radians(np.round(np.degrees(poses[:, 2])))
    prior = np.full((4, 1, 4), 1e-3)
    for readings, own in (
        (history_of(rng, rounded, noise=0.0), [1.5e-3, 5e-3, 1.0, 1.0]),
        (history_of(rng, poses, noise=np.array([0.02, 2e-4, 0])), [0.014, 1e-3, 1, 1]),
        (history_of(rng, poses, noise=0.0), [1e-3, 1e-3, 1.0, 1.0]),
    ):
        assert known_joint_reasons(known, readings) == []
        scale = np.tile(own, (4, 1, 1))
        assert noise_reasons(scene(), readings, scale, prior, None) == []


def test_what_moves_straight_while_it_turns_says_nothing_of_angles():
    """With noise and without; nor do discs, or what may slide along a wall."""
    rng = np.random.default_rng(9)
    angle = 2.0 * swing(rng, 121)
    along = swing(rng, 121)
    straight = np.column_stack([along, 0.4 * along, angle])
    # As a ladder that slides in a corner: its middle goes round against its turning.
    ladder = np.column_stack([np.cos(angle), np.sin(angle), -angle])
    for noise in (0.0, NOISE):
        history = history_of(rng, straight, noise=noise)
        assert angle_sense_reasons(scene(), history) == []
        history = history_of(rng, ladder, noise=noise)
        assert len(angle_sense_reasons(scene(), history)) == 1
        assert angle_sense_reasons(scene(shape=DISC), history) == []
        history = history_of(rng, ladder, 0.0 * ladder, noise=noise)
        assert angle_sense_reasons(beside_a_wall(), history) == []


def test_a_guide_that_moves_is_held_against_where_it_is():
    """The second box slides in the first, which turns."""
    rng = np.random.default_rng(10)
    rail = rolling(rng, swing(rng, 81))
    slide = 0.3 * swing(rng, 81)
    turn = np.column_stack([np.cos(rail[:, 2] + 0.4), np.sin(rail[:, 2] + 0.4)])
    box = np.column_stack([rail[:, :2] + slide[:, None] * turn, rail[:, 2]])
    ends = {"anchor_a": [0.0, 0.0], "anchor_b": [0.0, 0.0]}
    guide = joint("prismatic", "box1", **ends, axis=0.4)
    history = history_of(rng, box, rail)
    assert known_joint_reasons(scene(guide, num=2), history) == []
    (reason,) = known_joint_reasons(scene(guide | {"axis": 0.6}, num=2), history)
    assert "off its known guide to 'box1'" in reason


def test_scatter_bounds_noise_from_above():
    """Equal to it where nothing moves, more where something does; ends of runs out."""
    rng = np.random.default_rng(7)
    value = 0.01 * rng.normal(size=(2000, 2))
    run = np.arange(2000) // 50
    still = scatter(value + 10.0 * run[:, None], run)
    assert still == pytest.approx(0.01, rel=0.1)
    assert scatter(value + np.sin(np.arange(2000.0))[:, None], run) > 0.1
    wrapped = np.angle(np.exp(1j * (0.3 * np.arange(2000) + value[:, 0])))
    assert scatter(wrapped[:, None], run, is_angle=True) == pytest.approx(0.01, rel=0.1)
    assert scatter(value[:13, :1], run[:13]) is None
    value[::2] = np.nan
    assert scatter(value, run) == pytest.approx(0.01, rel=0.15)


def test_readings_come_in_order_one_of_each_instant():
    state = np.arange(5.0)[:, None, None] * np.ones((1, 1, 6))
    episode = np.array([0, 0, 0, 1, 1])
    follows = make_history(
        state, np.zeros((5, 1, 3)), state + 1.0, DT, episode=episode, capacity=8
    )
    readings = readings_in_order(scene(), follows)
    np.testing.assert_array_equal(readings.values[:, 0, 0], [0, 1, 2, 3, 3, 4, 5])
    np.testing.assert_array_equal(readings.run, [1, 1, 1, 1, 2, 2, 2])
