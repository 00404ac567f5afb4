"""`infer --out DIR/`: a sweep whose units are written, reported and resumed."""

import json
from pathlib import Path

import numpy as np
import pytest

from boomdp_jax.cli.main import main
from boomdp_jax.inference.members import Refusals
from boomdp_jax.inference.sweeps import sweep as sweeps
from tests.inference.sweeps.test_sweep import cheap_batch

SCENE = {
    "schema": "planar-scene-1",
    "gravity": [0, 0],
    "dt": 0.02,
    "bodies": [
        {
            "name": "table",
            "pose": [0, 0, 0],
            "shape": {"type": "box", "half_extents": [0.3, 0.2]},
        }
    ],
    "unknown": {"revolute": 1, "wheel": 1, "ground": 1},
}
NUM_FILES = 5
FILES = " ".join(f"data{number}.npz" for number in range(NUM_FILES))
COMMAND = f"infer {FILES} --scene scene.json --json --batch 2 --out out/"


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A folder with recordings, posteriors without inference; sizes of the calls."""
    monkeypatch.chdir(tmp_path)
    Path("scene.json").write_text(json.dumps(SCENE))
    for number in range(NUM_FILES):
        rng = np.random.default_rng(number)
        state = rng.normal(size=(4 + number, 1, 6))
        action = rng.normal(size=(4 + number, 1, 3))
        np.savez(
            f"data{number}.npz", state=state, action=action, next_state=state, dt=0.02
        )
    sizes = []

    def count(key, specs, histories, **options):
        print("not a report")
        sizes.append(len(specs))
        return cheap_batch(key, specs, histories, **options)

    monkeypatch.setattr(sweeps, "infer_batch", count)
    return sizes


def reports(capsys: pytest.CaptureFixture) -> list[dict]:
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_one_object_a_file_in_order_and_again_from_the_folder(
    calls: list, capsys: pytest.CaptureFixture
):
    assert main(COMMAND.split()) == 0
    first = reports(capsys)
    assert [report["schema"] for report in first] == ["boomdp-infer-1"] * NUM_FILES
    assert calls == [2, 2, 1]
    assert len({report["log_evidence"] for report in first}) == NUM_FILES
    assert all(report["seed"] == 0 for report in first)
    assert main([*COMMAND.split(), "--resume"]) == 0
    assert reports(capsys) == first
    assert calls == [2, 2, 1]


def test_shards_print_what_the_whole_does(calls: list, capsys: pytest.CaptureFixture):
    assert main(COMMAND.split()) == 0
    whole = reports(capsys)
    parted = COMMAND.replace("out/", "parts/").split()
    assert main([*parted, "--shard", "1/2"]) == 0
    second = reports(capsys)
    assert main([*parted, "--shard", "0/2"]) == 0
    first = reports(capsys)
    assert first + second == [whole[i] for i in (0, 1, 4, 2, 3)]


def test_results_that_are_there_ask_for_resume(
    calls: list, capsys: pytest.CaptureFixture
):
    assert main([*COMMAND.split(), "--shard", "0/3"]) == 0
    capsys.readouterr()
    assert main(COMMAND.split()) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert "out: expected no results of unit 0 yet, got some; resume" in output.err


def test_other_settings_are_refused_and_named(
    calls: list, capsys: pytest.CaptureFixture
):
    assert main([*COMMAND.split(), "--shard", "0/3"]) == 0
    capsys.readouterr()
    for change, message in (
        ("--seed 4", "out/sweep.json: seed: expected 0"),
        ("--outliers student-t", 'out/sweep.json: outliers: expected "none"'),
        ("--method map", 'out/sweep.json: method: expected "auto"'),
        ("--rows 3", "out/sweep.json: num_rows: expected null"),
    ):
        assert main([*COMMAND.split(), "--resume", *change.split()]) == 2
        assert message in capsys.readouterr().err


def test_what_inference_refuses_is_told_when_all_else_is_done(
    calls: list, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    def refuse(key, specs, histories, **options):
        refusals = Refusals(len(specs))
        for place, history in enumerate(histories):
            # Of the files data0.npz and data3.npz.
            with refusals.of(place):
                if int(np.sum(history.mask)) in (4, 7):
                    raise ValueError("scene: unknown: too many")
        refusals.check()
        return cheap_batch(key, specs, histories, **options)

    assert main(COMMAND.replace("out/", "whole/").split()) == 0
    whole = [report["bodies"] for report in reports(capsys)]
    monkeypatch.setattr(sweeps, "infer_batch", refuse)
    for more in ([], ["--resume"]):
        assert main([*COMMAND.split(), *more]) == 1
        output = capsys.readouterr()
        found = [json.loads(line) for line in output.out.splitlines()]
        assert [report["bodies"] for report in found] == [whole[i] for i in (1, 2, 4)]
        errors = [line for line in output.err.splitlines() if "error" in line]
        assert errors == [
            f"boomdp_jax: error: data{number}.npz: scene: unknown: too many"
            for number in (0, 3)
        ]
        assert output.err.splitlines()[-2:] == errors


def test_all_bad_files_are_named_before_the_work(
    calls: list, capsys: pytest.CaptureFixture
):
    none = np.zeros((0, 1, 6))
    np.savez("data1.npz", state=none, action=none[..., :3], next_state=none, dt=0.02)
    assert main(COMMAND.split()) == 2
    error = capsys.readouterr().err
    assert "error: data1.npz: expected at least one row, got none" in error
    Path("data4.npz").unlink()
    assert main(COMMAND.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "got 2 of 5 files that do not: data1.npz: expected at least one row" in line
    assert line.endswith("; data4.npz: No such file or directory")
    assert calls == []
    assert not Path("out").exists()


def test_without_a_sweep_the_files_that_are_refused_are_named_too(
    calls: list, capsys: pytest.CaptureFixture
):
    for number in (1, 3):
        state = np.full((4, 1, 6), np.nan)
        action = np.zeros((4, 1, 3))
        np.savez(
            f"data{number}.npz", state=state, action=action, next_state=state, dt=0.02
        )
    command = f"infer {FILES} --scene scene.json --likelihood one-step"
    assert main(command.split()) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    wrong = "boomdp_jax: error: data1.npz: scene.json: table: likelihood 'one-step'"
    assert error.startswith(wrong)
    assert error.endswith("'filtered' does without; refused as well: data3.npz")
