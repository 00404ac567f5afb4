"""The command line as a whole: arguments, exit status, one line on bad input."""

import importlib.metadata
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import boomdp_jax.inference
from boomdp_jax.cli.main import LIKELIHOODS, METHODS, OUTLIERS, main
from boomdp_jax.cli.output import numbered, without_non_finite
from boomdp_jax.inference.infer import OUTLIERS as KNOWN_OUTLIERS

SCENE = """{"schema": "planar-scene-1", "gravity": [0, 0], "dt": 0.02,
 "bodies": [{"name": "cart", "pose": [0, 0, 0],
   "shape": {"type": "box", "half_extents": [0.5, 0.3]}}],
 "unknown": {"wheel": 1}}"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder, made the current one, with a scene, rows and an empty recording."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.json").write_text(SCENE)
    (tmp_path / "broken.json").write_text(SCENE[:50])
    (tmp_path / "typo.json").write_text(SCENE.replace('"pose"', '"poze"'))
    for name, num_rows in (("data.npz", 3), ("empty.npz", 0)):
        np.savez(
            name,
            state=np.zeros((num_rows, 1, 6)),
            action=np.zeros((num_rows, 1, 3)),
            next_state=np.zeros((num_rows, 1, 6)),
            dt=0.02,
        )
    np.savez("two_bodies.npz", action=np.zeros((3, 2, 3)))
    np.savez("actions.npz", action=np.zeros((3, 1, 3)))
    return tmp_path


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("", "the following arguments are required: command"),
        ("guess data.npz", "invalid choice: 'guess'"),
        ("infer data.npz", "required: --scene"),
        ("infer --scene scene.json", "required: DATA.npz"),
        ("infer data.npz --scene scene.json --method mcmc", "auto"),
        ("infer data.npz --scene scene.json --likelihood kalman", "open-loop"),
        ("infer data.npz --scene scene.json --outliers gross", "student-t"),
        (
            "infer data.npz --scene scene.json --method nuts --outliers student-t",
            "outliers: expected none with method 'nuts'",
        ),
        (
            "infer data.npz --scene scene.json --horizon 0",
            "--horizon: expected",
        ),
        (
            "infer data.npz --scene scene.json --horizon 5",
            "horizon: expected none with likelihood 'filtered'",
        ),
        (
            "infer data.npz --scene scene.json --likelihood one-step --horizon 5",
            "horizon: expected none with likelihood 'one-step'",
        ),
        (
            "infer data.npz --scene scene.json --method nuts --likelihood open-loop",
            "likelihood: expected auto or one-step with method 'nuts', got 'open-loop'",
        ),
        ("infer data.npz --scene scene.json --rows 0", "--rows: expected a whole"),
        ("infer data.npz --scene scene.json --rows 1.5", "--rows: expected a whole"),
        ("infer data.npz --scene scene.json --seed -1", "--seed: expected a whole"),
        ("infer data.npz --scene missing.json", "missing.json: No such file"),
        ("infer missing.npz --scene scene.json", "missing.npz: No such file"),
        ("infer data.npz --scene broken.json", "broken.json: expected JSON"),
        ("infer data.npz --scene typo.json", "typo.json: body 'cart'"),
        ("infer scene.json --scene scene.json", "scene.json: expected an NPZ"),
        (
            "infer . --scene scene.json",
            r".: Is a directory; expected a file (of several",
        ),
        ("infer empty.npz --scene scene.json", "empty.npz: expected at least one row"),
        ("infer data.npz empty.npz --scene scene.json", "empty.npz: expected at least"),
        (
            "infer data.npz --scene scene.json --out no/post.npz",
            "no/post.npz: expected",
        ),
        pytest.param(
            "infer data.npz --scene scene.json --out /proc/post.npz",
            "/proc/post.npz: expected a folder to write to, got one that takes no",
            marks=pytest.mark.skipif(not Path("/proc").is_dir(), reason="no /proc"),
        ),
        ("infer data.npz --scene scene.json --out .", ".: expected a file"),
        ("infer data.npz --scene scene.json --plot fig.doc", "fig.doc: expected a fig"),
        (
            "infer data.npz --scene scene.json --shard 0/2",
            "--shard: expected --out with a folder that ends in /",
        ),
        (
            "infer data.npz --scene scene.json --batch 4 --out post.npz",
            "--batch: expected --out with a folder that ends in /, got post.npz",
        ),
        (
            "infer data.npz --scene scene.json --out out/ --shard 2/2",
            "--shard: expected I/N, whole numbers with 0 <= I < N, got '2/2'",
        ),
        (
            "infer data.npz --scene scene.json --out out/ --shard half",
            "--shard: expected I/N",
        ),
        ("infer data.npz --scene scene.json --out out/ --batch 0", "--batch: expected"),
        (
            "infer data.npz empty.npz --scene scene.json --out out/",
            "empty.npz: expected at least one row",
        ),
        ("infer data.npz --scene scene.json --out no/out/", "no/out: No such file"),
        ("predict post.npz", "required: DATA.npz"),
        ("predict post.npz data.npz --horizon 0", "--horizon: expected"),
        ("simulate scene.json --out o.npz", "required: --actions"),
        (
            "simulate scene.json --actions actions.npz --out o.npz",
            "scene.json: body 'cart': density: expected a number, got unknown",
        ),
        (
            "simulate scene.json --actions two_bodies.npz --out o.npz",
            "two_bodies.npz: action: expected 1 bodies",
        ),
        (
            "simulate scene.json --actions actions.npz --out o.npz --noise 1 1 -1 1",
            "--noise: expected a finite number of at least 0, got '-1'",
        ),
        (
            "simulate scene.json --actions actions.npz --out o.npz --draw 1",
            "--draw: expected --posterior",
        ),
        (
            "simulate scene.json --actions actions.npz --out no/o.npz",
            "no/o.npz: expected an existing folder",
        ),
    ],
)
def test_bad_input_is_one_line_status_2_and_nothing_written(
    folder: Path, capsys: pytest.CaptureFixture, command: str, message: str
):
    before = sorted(folder.iterdir())
    assert main(command.split()) == 2
    output = capsys.readouterr()
    assert output.out == ""
    errors = [line for line in output.err.splitlines() if ": error: " in line]
    assert len(errors) == 1
    assert message in errors[0]
    others = [line for line in output.err.splitlines() if line not in errors]
    assert all(line.startswith("boomdp_jax: note:") for line in others)
    assert sorted(folder.iterdir()) == before


def test_an_unknown_method_names_those_that_exist(
    folder: Path, capsys: pytest.CaptureFixture
):
    assert main("infer data.npz --scene scene.json --method mcmc".split()) == 2
    line = capsys.readouterr().err
    assert all(name in line for name in ("'mcmc'", "auto", "rj", "enumerate"))


def test_methods_are_those_of_the_library():
    assert METHODS == boomdp_jax.inference.METHODS
    assert LIKELIHOODS == boomdp_jax.inference.LIKELIHOODS
    assert OUTLIERS == tuple(KNOWN_OUTLIERS)


def test_help_is_status_0(capsys: pytest.CaptureFixture):
    assert main(["infer", "--help"]) == 0
    assert "--scene" in capsys.readouterr().out


def test_versions_are_told(capsys: pytest.CaptureFixture):
    assert main(["--version"]) == 0
    told = capsys.readouterr().out.strip()
    assert told.startswith(f"boomdp_jax {boomdp_jax.__version__}, jax ")
    assert f"numpyro {importlib.metadata.version('numpyro')}" in told


def test_the_module_runs_as_a_program(folder: Path):
    finished = subprocess.run(
        [sys.executable, "-m", "boomdp_jax", "infer", "data.npz"],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parents[2],
    )
    assert finished.returncode == 2
    assert finished.stdout == ""
    assert finished.stderr.splitlines() == [
        "boomdp_jax: error: the following arguments are required: --scene"
    ]


def test_xla_is_told_to_be_quiet_before_it_is_there():
    """Once it is loaded it does not ask again."""
    program = (
        "import os, sys; from boomdp_jax.cli.main import main; "
        "assert 'jax' not in sys.modules; "
        "main(['infer', 'none.npz', '--scene', 'none.json']); "
        "assert 'jax' in sys.modules; print(os.environ['TF_CPP_MIN_LOG_LEVEL'])"
    )
    environment = {k: v for k, v in os.environ.items() if not k.startswith("TF_")}
    finished = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
        env=environment,
    )
    assert finished.stdout.split() == ["3"]


def test_numbers_that_are_not_finite_become_null():
    value = {"a": [1.0, float("nan"), {"b": float("inf")}], "c": "nan", "d": 2}
    assert without_non_finite(value) == {
        "a": [1.0, None, {"b": None}],
        "c": "nan",
        "d": 2,
    }


def test_several_results_are_numbered_and_one_is_not():
    assert numbered("out/post.npz", 0, 1) == "out/post.npz"
    assert numbered("out/post.npz", 1, 3) == str(Path("out/post-1.npz"))
