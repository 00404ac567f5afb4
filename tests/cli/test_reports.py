"""What `infer` and `predict` print and write, with stand-ins for the library's work."""

import json
import sys
import types
from pathlib import Path

import numpy as np
import pytest

# Before parts of it are replaced: it is made of them.
import boomdp_jax.inference  # noqa: F401
from boomdp_jax.cli.main import main
from boomdp_jax.cli.predict import _table
from boomdp_jax.physics.scene_spec import scene_spec_from_dict

SCENE = {
    "schema": "planar-scene-1",
    "gravity": [0, 0],
    "dt": 0.02,
    "bodies": [
        {"name": "disc", "pose": [0, 0, 0], "shape": {"type": "circle", "radius": 0.3}}
    ],
}


class _Posterior:
    """Knows how many rows it has seen, and what it was asked to do."""

    def __init__(self, num_rows: int, options: dict):
        self.num_rows, self.options = num_rows, options
        self.spec = scene_spec_from_dict(SCENE)

    def to_json(self) -> dict:
        return {"rows": self.num_rows, "bound": float("inf"), **self.options}

    def summary(self) -> str:
        return f"{self.num_rows} rows"

    def save(self, path: str) -> None:
        Path(path).write_text(str(self.num_rows))

    def plot(self, path: str) -> None:
        print("drawing")
        Path(path).write_text("figure")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder with recordings of 3 and 5 rows; the library replaced."""

    def infer(key, spec, history, **options):
        print("sampling")
        return _Posterior(int(history.num_transitions), options)

    def infer_batch(key, specs, histories, **options):
        assert len({history.capacity for history in histories}) == 1
        return [
            infer(key, spec, history, **options)
            for spec, history in zip(specs, histories, strict=True)
        ]

    def predict(posterior, history, horizons):
        print("predicting")
        numbers = {"rmse": 0.5, "coverage90": 0.9, "baseline_rmse": None}
        return {
            "schema": "boomdp-predict-1",
            "horizons": {str(h): {"position": numbers} for h in horizons},
            "num_starts": {str(h): 4 for h in horizons},
        }

    stand_ins = {
        "infer": {"infer": infer, "infer_batch": infer_batch},
        "posteriors.posterior": {"load_posterior": lambda path: _Posterior(0, {})},
        "posteriors.predict": {"predict": predict},
    }
    for name, functions in stand_ins.items():
        full_name = f"boomdp_jax.inference.{name}"
        module = types.ModuleType(full_name)
        vars(module).update(functions)
        monkeypatch.setitem(sys.modules, full_name, module)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.json").write_text(json.dumps(SCENE))
    for name, num_rows in (("three.npz", 3), ("five.npz", 5)):
        np.savez(
            name,
            state=np.zeros((num_rows, 1, 6)),
            action=np.zeros((num_rows, 1, 3)),
            next_state=np.zeros((num_rows, 1, 6)),
            dt=0.02,
        )
    return tmp_path


def test_infer_prints_one_json_line_a_recording_in_order(
    folder: Path, capsys: pytest.CaptureFixture
):
    command = "infer three.npz five.npz --scene scene.json --json --method rj"
    assert main(command.split()) == 0
    output = capsys.readouterr()
    expected = {
        "bound": None,
        "horizon": None,
        "likelihood": "auto",
        "method": "rj",
        "outliers": "none",
        "progress": True,
    }
    assert [json.loads(line) for line in output.out.splitlines()] == [
        {"rows": 3, **expected},
        {"rows": 5, **expected},
    ]
    assert output.err.splitlines() == ["sampling", "sampling"]


def test_infer_prints_a_summary_for_people(folder: Path, capsys: pytest.CaptureFixture):
    assert main("infer five.npz --scene scene.json --rows 4".split()) == 0
    assert capsys.readouterr().out.splitlines() == ["five.npz", "4 rows"]


def test_infer_writes_one_posterior_and_figure_a_recording(folder: Path):
    before = set(folder.iterdir())
    command = "infer three.npz five.npz --scene scene.json --out p.npz --plot f.png"
    assert main(command.split()) == 0
    written = {path.name for path in set(folder.iterdir()) - before}
    assert written == {"p-0.npz", "p-1.npz", "f-0.png", "f-1.png"}
    assert Path("p-1.npz").read_text() == "5"


def test_predict_prints_the_report_and_nothing_else(
    folder: Path, capsys: pytest.CaptureFixture
):
    assert main("predict p.npz five.npz --horizon 2 4 --json".split()) == 0
    output = capsys.readouterr()
    report = json.loads(output.out)
    assert list(report["horizons"]) == ["2", "4"]
    assert output.err.splitlines() == ["predicting"]


def test_predict_prints_a_table_for_people(folder: Path, capsys: pytest.CaptureFixture):
    assert main("predict p.npz five.npz --horizon 2".split()) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == [
        "steps",
        "quantity",
        "rmse",
        "baseline_rmse",
        "coverage90",
        "log_score",
    ]
    assert lines[1].split() == ["2", "position", "0.5", "-", "0.9", "-"]


def test_predict_says_why_nothing_is_scored():
    none = dict.fromkeys(("rmse", "baseline_rmse", "coverage90", "log_score"))
    found = dict.fromkeys(none, 0.5)
    report = {
        "horizons": {
            "1": {"position": found, "velocity": none},
            "5": {"position": none},
            "20": {"position": none},
        },
        "num_starts": {"1": 7, "5": 3, "20": 0},
        "starts": "readings",
    }
    lines = _table(report).splitlines()
    assert [line.split()[0] for line in lines] == ["steps", *"11", *"55", "20", "20"]
    assert lines[4].endswith("5 steps: nothing was read so many steps later")
    assert "20 steps: nothing to predict from; expected rows whose state" in lines[6]
    *rest, last = _table(report | {"starts": "filtered"}).splitlines()
    assert rest == lines
    assert last == "no reading was whole: predicted from all readings until then"
