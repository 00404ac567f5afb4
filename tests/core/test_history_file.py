"""Transition files: what is written is read, and bad ones are refused by name."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.core.history_file import (
    load_history,
    load_transitions,
    save_history,
    save_transitions,
)


class _Scene(NamedTuple):
    """Two bodies, the second one static."""

    names: tuple[str, ...] = ("box", "wall")
    dt: float = 0.02
    is_static: np.ndarray = np.array([False, True])
    pose: np.ndarray = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 0.5]])


def _rows(num_rows: int = 6) -> dict[str, np.ndarray]:
    """One run of a moving box beside a wall, each instant read once."""
    rng = np.random.default_rng(0)
    readings = rng.normal(size=(num_rows + 1, 2, 6))
    readings[:, 1] = [1.0, 2.0, 0.5, 0.0, 0.0, 0.0]
    action = rng.normal(size=(num_rows, 2, 3))
    action[:, 1] = 0.0
    return {
        "state": readings[:-1].copy(),
        "action": action,
        "next_state": readings[1:].copy(),
        "dt": np.asarray(0.02),
        "episode": np.zeros(num_rows, np.int32),
    }


def _write(path: Path, **changes: np.ndarray | None) -> Path:
    """Rows with some arrays replaced, or left out."""
    arrays = {**_rows(), **changes}
    np.savez(path, **{name: a for name, a in arrays.items() if a is not None})
    return path


def test_rows_come_back_to_the_bit(tmp_path: Path):
    rows = _rows()
    save_transitions(tmp_path / "data.npz", **rows, params='{"seed": 1}')
    table = load_transitions(tmp_path / "data.npz")
    for name in ("state", "action", "next_state"):
        np.testing.assert_array_equal(getattr(table, name), rows[name])
    np.testing.assert_array_equal(table.dt, np.full(6, 0.02))
    assert table.params == '{"seed": 1}'


def test_a_history_survives_its_file(tmp_path: Path):
    rows = _rows()
    rows["state"][2, 0, 3] = np.nan
    rows["next_state"][1, 0, 3] = np.nan
    rows["episode"] = np.array([0, 0, 0, 4, 4, 4], np.int32)
    history = make_history(**rows, capacity=9)
    save_history(tmp_path / "data.npz", history)
    again = load_history(tmp_path / "data.npz", capacity=9)
    for name in ("state", "action", "next_state", "episode", "mask", "is_chained"):
        np.testing.assert_array_equal(getattr(again, name), getattr(history, name))
    np.testing.assert_array_equal(again.state_mask, history.state_mask)
    np.testing.assert_array_equal(again.next_state_mask, history.next_state_mask)


def test_the_first_rows_are_taken_and_more_than_there_are_is_all(tmp_path: Path):
    path = _write(tmp_path / "data.npz")
    history = load_history(path, num_rows=4)
    assert history.num_transitions == 4
    np.testing.assert_array_equal(history.state, _rows()["state"][:4])
    assert load_history(path, num_rows=0).num_transitions == 0
    assert load_history(path, num_rows=100).num_transitions == 6
    with pytest.raises(ValueError, match="num_rows: expected 0 or more, got -1"):
        load_history(path, num_rows=-1)


def test_a_force_at_a_point_becomes_a_wrench(tmp_path: Path):
    rows = _rows(1)
    rows["state"][0, 0, :2] = [1.0, 1.0]
    action = np.array([[[2.0, 3.0, 0.5], [0.0, 0.0, 0.0]]])
    point = np.array([[[1.5, 3.0], [np.nan, np.nan]]])
    path = _write(tmp_path / "data.npz", **{**rows, "action": action, "point": point})
    history = load_history(path, spec=_Scene())
    # Arm (0.5, 2) x force (2, 3) = 1.5 - 4.
    np.testing.assert_allclose(history.action[0, 0], [2.0, 3.0, 0.5 + 1.5 - 4.0])
    np.testing.assert_allclose(history.action[0, 1], 0.0)


def test_a_point_of_nan_is_the_reference_point(tmp_path: Path):
    rows = _rows(2)
    rows["state"][:, 0, :2] = [1.0, 1.0]
    action = np.zeros((2, 2, 3))
    action[:, 0] = [2.0, 3.0, 0.5]
    point = np.full((2, 2, 2), np.nan)
    point[1, 0] = [1.5, 3.0]
    path = _write(tmp_path / "data.npz", **{**rows, "action": action, "point": point})
    history = load_history(path, spec=_Scene())
    np.testing.assert_allclose(history.action[:, 0, 2], [0.5, 0.5 + 1.5 - 4.0])


def test_a_force_at_a_point_of_a_body_that_was_not_seen_is_refused(tmp_path: Path):
    rows = _rows()
    rows["state"][3, 0, 0] = np.nan
    path = _write(tmp_path / "data.npz", state=rows["state"], point=np.zeros((6, 2, 2)))
    with pytest.raises(ValueError, match=r"data\.npz: point: .* body 0 .* row 3"):
        load_history(path)


def test_another_step_length_warns_and_holds(tmp_path: Path):
    path = _write(tmp_path / "data.npz", dt=np.asarray(0.01))
    with pytest.warns(UserWarning, match=r"0\.01 s overrides the scene's 0\.02 s"):
        history = load_history(path, spec=_Scene())
    np.testing.assert_allclose(history.dt, 0.01)


def test_step_lengths_that_vary_warn_of_all_of_them(tmp_path: Path):
    dt = np.array([0.056, 0.015, 0.02, 0.03, 0.08, 0.02])
    path = _write(tmp_path / "data.npz", dt=dt)
    message = r"dt: 0\.015 to 0\.08 s \(median 0\.025 s\) override the scene's 0\.02 s"
    with pytest.warns(UserWarning, match=message):
        history = load_history(path, spec=_Scene())
    np.testing.assert_allclose(history.dt, dt)


def test_an_array_of_unknown_name_warns(tmp_path: Path):
    path = _write(tmp_path / "data.npz", episodes=np.zeros(6, int))
    with pytest.warns(UserWarning, match="ignored arrays episodes"):
        load_history(path)


def test_missing_readings_of_a_static_body_are_those_of_the_scene(tmp_path: Path):
    rows = _rows()
    rows["state"][:, 1] = np.nan
    path = _write(tmp_path / "data.npz", state=rows["state"])
    history = load_history(path, spec=_Scene())
    np.testing.assert_allclose(
        history.state[:, 1, :3], np.tile([1.0, 2.0, 0.5], (6, 1))
    )
    assert bool(np.all(history.state_mask[:, 1]))


def test_a_batch_of_histories_is_not_written(tmp_path: Path):
    import jax

    history = jax.tree.map(lambda leaf: leaf[None], make_history(**_rows()))
    with pytest.raises(ValueError, match=r"expected one, got a batch of shape \(1,\)"):
        save_history(tmp_path / "data.npz", history)


def _with(name: str, index: tuple, value: float) -> dict[str, np.ndarray]:
    array = _rows()[name]
    array[index] = value
    return {name: array}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"state": None}, r"expected an array 'state', got action, dt, "),
        ({"dt": None}, r"expected an array 'dt'"),
        (
            {"state": np.zeros((6, 2, 5))},
            r"state: .*\[time, body, 6\], got \[6, 2",
        ),
        ({"state": np.zeros((6, 12))}, r"state: expected shape .* got \[6, 12\]"),
        ({"action": np.zeros((5, 2, 3))}, r"action: .*\[6, 2, 3\], got \[5, 2, 3\]"),
        (
            {"next_state": np.zeros((6, 1, 6))},
            r"next_state: .* \[6, 2, 6\]",
        ),
        (
            {"state": np.full((6, 2, 6), "a")},
            r"state: expected real numbers.*<U1",
        ),
        ({"state": np.zeros((6, 2, 6), complex)}, r"expected real numbers, .*complex"),
        (
            _with("action", (3, 0, 1), np.nan),
            r"action: .* row 3, body 0",
        ),
        (
            _with("action", (2, 1, 1), np.inf),
            r"action: .* row 2, body 1",
        ),
        (_with("state", (4, 0, 1), np.inf), r"state: expected finite readings.* row 4"),
        ({"dt": np.asarray(0.0)}, r"dt: expected positive seconds, got 0"),
        ({"dt": np.asarray(np.nan)}, r"dt: expected positive seconds, got nan"),
        (
            {"dt": np.where(np.arange(6) == 4, -0.1, 0.1)},
            r"dt: expected positive seconds, got -0.1 in row 4",
        ),
        ({"dt": np.full(4, 0.02)}, r"dt: expected shape \[6\], got \[4\]"),
        ({"episode": np.zeros(6)}, r"episode: expected whole numbers"),
        ({"episode": np.arange(6) * 2**33}, r"of 32 bit, got 8589934592"),
        ({"episode": np.array([0, 0, 1, 1, 0, 0])}, r"episode: .*taken up again"),
        ({"point": np.zeros((6, 2, 3))}, r"point: expected shape \[6, 2, 2\]"),
        (
            {"schema": np.asarray("planar-transitions-2")},
            r"schema: expected 'pl",
        ),
        (_with("action", (0, 1, 0), 1.0), r"body 'wall': action: expected zeros"),
        (_with("state", (2, 1, 0), 1.1), r"body 'wall': state: .* one that moves"),
        (_with("state", (2, 1, 4), 0.1), r"body 'wall': state: .* one that moves"),
    ],
)
def test_bad_rows_are_refused_by_name(tmp_path: Path, changes: dict, message: str):
    path = _write(tmp_path / "data.npz", **changes)
    with pytest.raises(ValueError, match=message) as caught:
        load_history(path, spec=_Scene())
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_another_number_of_bodies_than_in_the_scene_is_refused(tmp_path: Path):
    rows = {name: a[:, :1] for name, a in _rows().items() if a.ndim == 3}
    path = _write(tmp_path / "data.npz", **rows)
    with pytest.raises(ValueError, match=r"expected 2 bodies, .* \(box, wall\), got 1"):
        load_history(path, spec=_Scene())


def test_a_static_body_elsewhere_than_in_the_scene_is_refused(tmp_path: Path):
    rows = _rows()
    for name in ("state", "next_state"):
        rows[name][:, 1, 0] += 0.1
    path = _write(tmp_path / "data.npz", **rows)
    with pytest.raises(ValueError, match=r"body 'wall': state: expected the pose"):
        load_history(path, spec=_Scene())


def test_too_small_a_capacity_is_refused_with_the_file(tmp_path: Path):
    path = _write(tmp_path / "data.npz")
    with pytest.raises(ValueError, match=r"data\.npz: capacity: .*at least 6 rows"):
        load_history(path, capacity=5)


def test_bad_rows_are_not_written(tmp_path: Path):
    rows = _rows()
    rows["action"][0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="action: expected finite wrenches"):
        save_transitions(tmp_path / "data.npz", **rows)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_missing_is_named_by_the_file_given(tmp_path: Path):
    path = tmp_path / "missing" / "data.npz"
    with pytest.raises(FileNotFoundError) as caught:
        save_history(path, make_history(**_rows()))
    assert caught.value.filename == str(path)
