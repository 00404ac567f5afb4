"""Every example runs to its end with `--quick`, with its table and its figure."""

import os
import pathlib
import subprocess
import sys

import numpy as np
import pytest

EXAMPLES = pathlib.Path(__file__).parents[1] / "examples"
LIMIT = 900
"""Seconds for a quick run. Compilation takes most of it: minutes on two busy cores,
where 60 s is the aim."""


def run_example(name, *arguments):
    """Run a script as a user would; its exit status, output and messages."""
    return subprocess.run(
        [sys.executable, str(EXAMPLES / name), *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=LIMIT,
        env={**os.environ, "PYTHONPATH": str(EXAMPLES.parent)},
        check=False,
    )


def assert_is_picture(path):
    """A PNG that is more than one colour."""
    image = pytest.importorskip("matplotlib.image").imread(path)
    assert np.ptp(image[..., :3]) > 0.5
    assert min(image.shape[:2]) > 300


def swing(length, mass, friction, *, seed):
    """Rows of a made-up motor record: a pendulum swung by a slow torque at 200 Hz."""
    step, angle, rate = 0.005, 0.0, 0.0
    rng = np.random.default_rng(seed)
    rows = []
    for index in range(600):
        now = step * index
        torque = 1.6 * np.sin(2.6 * now + seed) + 0.8 * np.sin(6.1 * now)
        noise = rng.normal(0.0, [0.0015, 0.05])
        rows.append([now, angle + noise[0], rate + noise[1], torque])
        for _ in range(5):
            rub = friction * np.tanh(rate / 0.01)
            pull = mass * 9.81 * length * np.sin(angle)
            rate += 0.2 * step * (torque - rub - pull) / (mass * length**2)
            angle += 0.2 * step * rate
    return np.array(rows)


@pytest.mark.slow
def test_first_example_tells_what_objects_are(tmp_path):
    result = run_example("01_what_is_this_object.py", "--quick", "--out", tmp_path)
    assert result.returncode == 0, result.stderr[-2000:]
    assert "=== table ===" in result.stdout
    assert "=== cart ===" in result.stdout
    assert "truth: revolute" in result.stdout
    assert_is_picture(tmp_path / "what_is_this_object.png")
    assert {path.name for path in tmp_path.glob("*.npz")} == {
        f"{family}_{part}.npz"
        for family in ("table", "cart")
        for part in ("seen", "later")
    }


@pytest.mark.slow
def test_second_example_weighs_a_made_up_pendulum(tmp_path):
    header = "time,position,velocity,torque"
    for run in (1, 2):
        path = tmp_path / f"swing_up_{run}.csv"
        rows = swing(0.5, 0.7, 0.2, seed=run)
        np.savetxt(path, rows, delimiter=",", header=header, comments="")
    result = run_example(
        "02_real_pendulum.py", tmp_path, "--quick", "--out", tmp_path / "out"
    )
    assert result.returncode == 0, result.stderr[-2000:]
    lines = result.stdout.splitlines()
    line = next(line for line in lines if line.startswith("mass "))
    assert float(line.split()[1]) == pytest.approx(0.7, rel=0.15)
    assert any(line.startswith("pin  ") for line in lines)
    assert_is_picture(tmp_path / "out" / "real_pendulum.png")


def test_second_example_says_which_recording_is_missing(tmp_path):
    result = run_example("02_real_pendulum.py", tmp_path)
    assert result.returncode == 2
    assert "swing_up_1.csv: no such recording" in result.stderr
