"""Episodes of runs as trajectories: what was recorded is what is shown."""

import numpy as np
import pytest

from boomdp_jax.cli import main as cli
from boomdp_jax.core.json_file import write_json
from boomdp_jax.core.npz_file import write_npz
from boomdp_jax.envs.cart import GOAL, ROOM, START
from boomdp_jax.experiments.replay import replay
from boomdp_jax.experiments.run import SCHEMA


@pytest.fixture
def folder(tmp_path):
    """A cart that went straight in three steps, of five that it was given."""
    content = {"schema": SCHEMA, "task": "cart", "agent": "true", "num_seeds": 2}
    write_json(tmp_path / "run.json", {**content, "num_steps": 5, "noise": None})
    states = np.full((5, 1, 6), np.nan)
    states[:3, 0] = 0.0
    states[:3, 0, :2] = np.linspace(START[:2], GOAL, 3)
    action = np.array([0, 0, 0, -1, -1])
    write_npz(tmp_path / "seed-00001.npz", {"state": states, "action": action})
    return tmp_path


def test_poses_are_those_of_the_record_and_lie_straight_between(folder):
    shown = replay(folder)
    way = np.asarray(shown.states.pose)[:, 0, :2]
    num_parts = (len(way) - 1) // 2
    assert shown.dt * num_parts == pytest.approx(0.4)
    assert shown.dt <= 0.1
    np.testing.assert_allclose(way[::num_parts], np.linspace(START[:2], GOAL, 3))
    np.testing.assert_allclose(np.diff(way, axis=0, n=2), 0.0, atol=1e-12)
    assert shown.title == "cart, true, episode 1"


def test_walls_stand_where_the_room_has_them(folder):
    shown = replay(folder)
    assert shown.spec.names[0] == "cart"
    middle = np.array(ROOM).reshape(-1, 2, 2).mean(axis=1)
    poses = np.asarray(shown.states.pose)[:, 1:, :2]
    np.testing.assert_allclose(poses, np.broadcast_to(middle, poses.shape))


def test_an_episode_that_is_not_there_is_refused(folder, capsys):
    command = ["view", str(folder), "--out", str(folder / "a.html")]
    assert cli.main([*command, "--episode", "0"]) == 2
    assert "--episode: expected one of 1 to 1 that is done, got 0" in (
        capsys.readouterr().err
    )
    assert cli.main([*command, "--scene", "x.json"]) == 2
    assert "--scene: expected none for a run" in capsys.readouterr().err
    (folder / "seed-00001.npz").unlink()
    assert cli.main(command) == 2
    assert "expected at least one episode, got none yet" in capsys.readouterr().err


def test_the_command_draws_it(folder):
    path = folder / "a.html"
    assert cli.main(["view", str(folder), "--out", str(path)]) == 0
    assert "wall 4" in path.read_text(encoding="utf-8")


def test_an_episode_without_a_step_cannot_be_shown(folder):
    record = {"state": np.full((5, 1, 6), np.nan), "action": np.full(5, -1)}
    write_npz(folder / "seed-00001.npz", record)
    with pytest.raises(ValueError, match="episode 1: expected a step, got none"):
        replay(folder)
