"""Runs of robots among furniture: written room by room, taken up again, refused."""

import numpy as np
import pytest

from boomdp_jax.cli.main import main
from boomdp_jax.core.npz_file import read_npz
from boomdp_jax.envs import is_solvable, namo_rooms, random_room, story_room
from boomdp_jax.envs.namo_rooms import is_closed
from boomdp_jax.experiments import begin_namo
from boomdp_jax.experiments.namo import true_numbers


@pytest.mark.slow
@pytest.mark.parametrize("num_things", [2, 4, 8])
def test_random_rooms_are_closed_and_can_be_solved(num_things):
    for seed in range(3):
        room = random_room(seed, num_things)
        assert room.num_things == num_things
        assert is_closed(room)
        assert is_solvable(room)
        assert random_room(seed, num_things) == room


def test_a_search_without_end_is_given_up(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(namo_rooms, "_try_room", lambda *_: None)
    status = main(["run", "namo", "--agent", "true", "--out", str(tmp_path / "run")])
    assert status == 2
    assert "seed: expected one with a room of 4 things" in capsys.readouterr().err


def test_a_room_in_which_nothing_moves_cannot_be_solved():
    room = random_room(0, 2)
    fixed = tuple(thing._replace(kind="fixed") for thing in room.things)
    assert not is_solvable(room._replace(things=fixed))


def test_the_story_can_be_solved_by_the_couch_alone():
    for seed in range(5):
        room = story_room(seed)
        couch, table = room.things
        assert is_closed(room)
        assert table.kind == "revolute"
        assert is_solvable(room)
        stuck = room._replace(things=(couch._replace(kind="fixed"), table))
        assert not is_solvable(stuck)


def test_what_is_true_of_a_thing_alone_is_what_is_true_of_it_in_the_room():
    room = story_room(0)
    couch, table = true_numbers(room)
    assert np.asarray(couch.ground.active).all()
    assert not np.asarray(couch.revolute.active).any()
    assert np.asarray(table.revolute.active).all()
    assert not np.asarray(table.ground.active).any()
    assert float(couch.density[0, 0]) == pytest.approx(room.things[0].density)
    assert np.asarray(table.revolute.anchor_a[0, 0]) == pytest.approx(
        room.things[1].pin
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"agent": "lwr"}, "agent: expected one of true, .*got 'lwr'"),
        ({"num_seeds": 0}, "num_seeds: expected at least 1, got 0"),
        ({"room": "hall"}, "room: expected story or random, got 'hall'"),
        ({"num_things": 1}, "num_things: expected at least 2, got 1"),
        ({"num_things": 30}, "num_things: expected at most 12, got 30"),
        ({"difficulty": 2.0}, r"difficulty: expected in \[0, 1\], got 2.0"),
    ],
)
def test_what_cannot_be_is_refused(options, message, tmp_path):
    given = {"agent": "true", "num_seeds": 1, **options}
    with pytest.raises(ValueError, match=message):
        begin_namo(given.pop("agent"), tmp_path / "run", **given)
    assert not (tmp_path / "run").exists()


def test_the_command_line_writes_rooms_and_goes_on(tmp_path, capsys):
    arguments = ["run", "namo", "--agent", "navigation", "--things", "2"]
    arguments += ["--out", str(tmp_path), "--seeds"]
    assert main([*arguments, "2"]) == 0
    assert "0 of 2 rooms solved" in capsys.readouterr().out
    results = read_npz(tmp_path / "results.npz")
    assert results["is_solved"].tolist() == [False, False]
    assert results["num_pushes"].tolist() == [0, 0]
    before = (tmp_path / "seed-00000.npz").stat().st_mtime_ns
    (tmp_path / "seed-00001.npz").write_bytes(b"cut short")
    assert main([*arguments, "2"]) == 0
    assert (tmp_path / "seed-00000.npz").stat().st_mtime_ns == before
    # There are no rewards over steps to draw.
    assert main(["plot", str(tmp_path)]) == 2
    assert "expected one with a reward for each step, got 'namo'" in (
        capsys.readouterr().err
    )
    assert not (tmp_path / "curves.png").exists()
    # More rooms are added, and none is taken away.
    assert main([*arguments, "3"]) == 0
    assert "0 of 3 rooms solved" in capsys.readouterr().out
    assert (tmp_path / "seed-00000.npz").stat().st_mtime_ns == before
    assert read_npz(tmp_path / "results.npz")["is_solved"].tolist() == [False] * 3
    assert main([*arguments, "2"]) == 2
    assert "num_seeds: expected 3" in capsys.readouterr().err
    # Another run in the same folder is refused.
    assert main([*arguments, "3", "--difficulty", "0"]) == 2
    assert "difficulty: expected 0.5" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["namo", "--steps", "5"], "--steps: expected none for namo, got 5"),
        (["cart", "--things", "3"], "--things: expected none for cart"),
        (
            ["namo", "--room", "story", "--things", "3"],
            "--things: expected none with --room story, got 3",
        ),
        (
            ["namo", "--room", "story", "--difficulty", "0"],
            "--difficulty: expected none with --room story, got 0.0",
        ),
    ],
)
def test_options_of_other_tasks_are_refused(extra, message, tmp_path, capsys):
    task, *options = extra
    status = main(["run", task, "--agent", "true", *options, "--out", str(tmp_path)])
    assert status == 2
    assert message in capsys.readouterr().err
