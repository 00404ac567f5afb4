"""Doubts that readings alone give: senses of angles, known joints, too much noise."""

import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.inference.angle_sense import angle_sense_reasons
from boomdp_jax.inference.known_joints import known_joint_reasons
from boomdp_jax.inference.noise_doubts import noise_reasons
from boomdp_jax.inference.reading_sequence import readings_in_order, scatter
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
    angle = swing(rng, 81)
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
    prior, kicks = np.full((4, 1, 4), 1e-3), np.full((4, 1, 2), 1e-3)

    def reasons(scale, shape=BOX):
        known = np.tile(scale, (4, 1, 1)), prior, kicks
        return noise_reasons(scene(shape=shape), history, *known)

    assert reasons(own) == []
    assert reasons(2.0 * own) == []
    none = history_of(rng, np.zeros((1, 3)), capacity=4)
    known = np.tile(100.0 * own, (4, 1, 1)), prior, kicks
    assert noise_reasons(scene(), none, *known) == []
    (reason,) = reasons(own * [7.0, 1.0, 1.0, 1.0])
    assert "readings of its position are taken to be off by 0.007 m" in reason
    (reason,) = reasons(own * [1.0, 10.0, 1.0, 1.0])
    assert "readings of its angle" in reason
    # Whatever readings scatter by, as where they are millimetres or degrees.
    kicks[..., 1] = 19.0
    (reason,) = reasons(own)
    assert "its angle is taken to be off or to change by chance by 0.95 rad" in reason
    kicks[...] = [209.0, 1e-3]
    (reason,) = reasons(own)
    assert "its position is taken to be off or to change by chance by 10 m" in reason
    kicks[..., 0] = 170.0
    assert reasons(own, DISC) == []
    kicks[..., 0] = 190.0
    assert len(reasons(own, DISC)) == 1


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
