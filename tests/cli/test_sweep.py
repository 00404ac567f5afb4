"""`infer --out DIR/`: a sweep whose units are written, reported and resumed."""

import json
from pathlib import Path

import numpy as np
import pytest

from boomdp_jax.cli.main import main
from boomdp_jax.inference import sweep as sweeps
from tests.inference.test_sweep import cheap_batch

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
