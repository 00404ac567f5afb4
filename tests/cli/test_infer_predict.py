"""From a recording to a posterior, a prediction and a new simulation, by commands."""

import json
from pathlib import Path

import numpy as np
import pytest

from boomdp_jax.cli.main import main
from boomdp_jax.core.history_file import load_transitions

pytest.importorskip("boomdp_jax.inference.infer")

SCENE = {
    "schema": "planar-scene-1",
    "gravity": [0, 0],
    "dt": 0.02,
    "bodies": [
        {
            "name": "box",
            "pose": [0, 0, 0],
            "shape": {"type": "box", "half_extents": [0.5, 0.3]},
        }
    ],
    "unknown": {},
}
DENSITY = 20.0
QUANTITIES = {"position", "angle", "velocity", "spin"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene of unknown density, and two recordings of a box of 20 kg/m²."""
    folder = tmp_path_factory.mktemp("commands")
    truth = json.loads(json.dumps(SCENE))
    truth["bodies"][0]["density"] = DENSITY
    (folder / "truth.json").write_text(json.dumps(truth))
    (folder / "scene.json").write_text(json.dumps(SCENE))
    action = np.random.default_rng(0).normal(size=(60, 1, 3)) * [20.0, 20.0, 5.0]
    np.savez(folder / "actions.npz", action=action)
    for seed in (0, 1):
        command = (
            f"simulate {folder}/truth.json --actions {folder}/actions.npz --out "
            f"{folder}/data{seed}.npz --noise 0.001 0.001 0.004 0.004 --seed {seed}"
        )
        assert main(command.split()) == 0
    return folder


@pytest.fixture(scope="module")
def posterior(folder: Path) -> Path:
    """The posterior that `infer` wrote for the first recording."""
    command = (
        f"infer {folder}/data0.npz --scene {folder}/scene.json --rows 40 "
        f"--out {folder}/post.npz"
    )
    assert main(command.split()) == 0
    return folder / "post.npz"


@pytest.mark.slow
def test_infer_prints_one_object_a_recording_and_nothing_else(
    folder: Path, capsys: pytest.CaptureFixture
):
    command = (
        f"infer {folder}/data0.npz {folder}/data1.npz --scene {folder}/scene.json "
        f"--json --out {folder}/both.npz"
    )
    assert main(command.split()) == 0
    reports = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(reports) == 2
    for report in reports:
        assert report["schema"] == "boomdp-infer-1"
        mass = report["bodies"]["box"]["mass"]
        assert report["bodies"]["box"]["identified"] is True
        # Four standard deviations: a false alarm in 16,000 runs.
        assert abs(mass["mean"] - DENSITY * 0.6) < 4 * mass["sd"]
        total = sum(entry["probability"] for entry in report["structure"])
        np.testing.assert_allclose(total, 1.0, atol=1e-6)
    assert {path.name for path in folder.glob("both*")} == {"both-0.npz", "both-1.npz"}


@pytest.mark.slow
def test_predict_prints_one_object(
    folder: Path, posterior: Path, capsys: pytest.CaptureFixture
):
    command = f"predict {posterior} {folder}/data1.npz --horizon 1 10 --json"
    assert main(command.split()) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1
    report = json.loads(lines[0])
    assert report["schema"] == "boomdp-predict-1"
    assert set(report["horizons"]) == {"1", "10"}
    ten = report["horizons"]["10"]
    assert set(ten) == QUANTITIES
    assert ten["velocity"]["rmse"] < ten["velocity"]["baseline_rmse"]


@pytest.mark.slow
def test_predict_prints_a_table_for_people(
    folder: Path, posterior: Path, capsys: pytest.CaptureFixture
):
    assert main(f"predict {posterior} {folder}/data1.npz --horizon 5".split()) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1 + len(QUANTITIES)
    assert {line.split()[1] for line in lines[1:]} == QUANTITIES


@pytest.mark.slow
def test_a_draw_simulates_the_box_it_describes(folder: Path, posterior: Path):
    from boomdp_jax.inference.posteriors.posterior import load_posterior

    command = (
        f"simulate {folder}/scene.json --actions {folder}/actions.npz --out "
        f"{folder}/again.npz --posterior {posterior} --draw 3"
    )
    assert main(command.split()) == 0
    mass = 0.6 * float(load_posterior(posterior).params.density[3, 0])
    table = load_transitions(folder / "again.npz")
    # Newton's law for a free body, row by row.
    change = table.next_state[:, 0, 3:5] - table.state[:, 0, 3:5]
    expected = table.action[:, 0, :2] * 0.02 / mass
    np.testing.assert_allclose(change, expected, rtol=1e-5, atol=1e-9)


@pytest.mark.slow
def test_a_draw_that_does_not_exist_is_refused(
    folder: Path, posterior: Path, capsys: pytest.CaptureFixture
):
    command = (
        f"simulate {folder}/scene.json --actions {folder}/actions.npz --out "
        f"{folder}/never.npz --posterior {posterior} --draw 100000000"
    )
    assert main(command.split()) == 2
    assert "--draw: expected less than" in capsys.readouterr().err
    assert not (folder / "never.npz").exists()
