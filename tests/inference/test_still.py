"""Bodies at rest that nothing pushes: when a posterior says so."""

import numpy as np
import pytest

from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.still import still_notes
from boomdp_jax.physics.scene_spec import scene_spec_from_dict
from tests.inference.recordings import DT, NOISE, SIZE, box_scene

NUM = 30


def recorded(
    speed=(0.0, 0.0, 0.0), force: float = 0.0, seed: int = 0, angle: float = 0.3
) -> History:
    """Two runs of a free box that keeps its twist, read with noise."""
    rng = np.random.default_rng(seed)
    time = DT * np.arange(NUM + 1)[:, None]
    pose = np.array([0.4, -0.2, angle]) + time * np.array(speed)
    true = np.concatenate([pose, np.tile(speed, (NUM + 1, 1))], axis=1)
    runs = [true + NOISE * rng.standard_normal(true.shape) for _ in range(2)]
    for run in runs:
        run[:, 2] = np.mod(run[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    action = np.zeros((2 * NUM, 1, 3))
    action[3, 0, 0] = force
    return make_history(
        np.concatenate([run[:-1] for run in runs])[:, None],
        action,
        np.concatenate([run[1:] for run in runs])[:, None],
        DT,
        episode=np.repeat([0, 1], NUM),
    )


@pytest.mark.parametrize("angle", [0.3, np.pi])
@pytest.mark.parametrize("seed", range(5))
def test_a_body_at_rest_is_named(seed, angle):
    (note,) = still_notes(box_scene(), recorded(seed=seed, angle=angle))
    assert "nothing pushed it and it did not move" in note


@pytest.mark.parametrize(
    "changes",
    [
        {"speed": (0.02, 0.0, 0.0)},
        {"speed": (0.0, 0.0, -0.05)},
        {"force": 0.1},
    ],
    ids=["slides", "turns", "pushed"],
)
def test_one_that_moves_or_is_pushed_is_not(changes):
    assert still_notes(box_scene(), recorded(**changes)) == []


@pytest.mark.parametrize("begins", [0, NUM // 2])
def test_one_that_flies_past_a_camera_is_not(begins):
    """Which reads no velocities; it may begin to move halfway."""
    time = np.maximum(np.arange(NUM + 1) - begins, 0) * DT
    run = np.column_stack([time, 0.0 * time, 0.0 * time])
    run = run + NOISE[:3] * np.random.default_rng(0).standard_normal(run.shape)
    run = np.column_stack([run, np.full((NUM + 1, 3), np.nan)])[:, None]
    history = make_history(run[:-1], np.zeros((NUM, 1, 3)), run[1:], DT)
    assert still_notes(box_scene(), history) == []


def test_on_a_slope_rest_does_tell_something():
    shape = {"type": "box", "half_extents": SIZE}
    content = {"schema": "planar-scene-1", "dt": DT, "gravity": [0.0, -1.0]}
    content["bodies"] = [{"name": "box", "shape": shape}]
    assert still_notes(scene_spec_from_dict(content), recorded()) == []


def test_a_few_rows_are_too_few_to_say_so():
    history = recorded()
    few = make_history(
        history.state[:3], history.action[:3], history.next_state[:3], DT
    )
    assert still_notes(box_scene(), few) == []
