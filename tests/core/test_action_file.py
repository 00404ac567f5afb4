"""Action files: wrenches for a simulation, checked against the scene."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from boomdp_jax.core.action_file import load_actions


class _Scene(NamedTuple):
    """Two bodies, the second one static."""

    names: tuple[str, ...] = ("box", "wall")
    dt: float = 0.02
    is_static: np.ndarray = np.array([False, True])
    pose: np.ndarray = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 0.5]])


def _action(num_rows: int = 4) -> np.ndarray:
    action = np.random.default_rng(0).normal(size=(num_rows, 2, 3))
    action[:, 1] = 0.0
    return action


def _write(path: Path, **arrays: np.ndarray) -> Path:
    np.savez(path, **{"action": _action(), **arrays})
    return path


def test_what_a_file_leaves_out_is_the_scene_s(tmp_path: Path):
    actions = load_actions(_write(tmp_path / "a.npz"), _Scene())
    np.testing.assert_array_equal(actions.action, _action())
    np.testing.assert_array_equal(actions.dt, np.full(4, 0.02))
    np.testing.assert_array_equal(actions.is_start, [True, False, False, False])
    assert actions.initial_state is None
    assert actions.point is None


def test_each_episode_has_one_start(tmp_path: Path):
    path = _write(tmp_path / "a.npz", episode=np.array([7, 7, 2, 2]))
    np.testing.assert_array_equal(
        load_actions(path, _Scene()).is_start, [True, False, True, False]
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"action": np.zeros((4, 3, 3))}, r"action: expected 2 bodies.*got 3"),
        ({"action": np.zeros((0, 2, 3))}, r"action: expected at least one row"),
        ({"action": np.full((4, 2, 3), np.nan)}, r"action: expected finite wrenches"),
        ({"action": np.ones((4, 2, 3))}, r"body 'wall': action: expected zeros"),
        ({"dt": np.asarray(-0.1)}, r"dt: expected positive seconds, got -0.1"),
        ({"episode": np.array([0, 1, 0, 1])}, r"episode: .*taken up again"),
        (
            {"initial_state": np.zeros((1, 6))},
            r"initial_state: .*\[2, 6\]",
        ),
        (
            {"initial_state": np.full((2, 6), np.nan)},
            r"body 'box': initial_state: expected finite",
        ),
        (
            {"initial_state": np.ones((2, 6))},
            r"body 'wall': initial_state: expected zero twist",
        ),
        (
            {"point": np.full((4, 2, 2), np.nan)},
            r"point: expected a point wherever .* body 'box'",
        ),
    ],
)
def test_bad_actions_are_refused_by_name(tmp_path: Path, changes: dict, message: str):
    path = _write(tmp_path / "a.npz", **changes)
    with pytest.raises(ValueError, match=message) as caught:
        load_actions(path, _Scene())
    assert str(caught.value).startswith(f"{path}: ")


def test_another_step_length_warns(tmp_path: Path):
    path = _write(tmp_path / "a.npz", dt=np.asarray(0.05))
    with pytest.warns(UserWarning, match=r"0\.05 s overrides the scene's 0\.02 s"):
        actions = load_actions(path, _Scene())
    np.testing.assert_array_equal(actions.dt, np.full(4, 0.05))
