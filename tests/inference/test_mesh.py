"""Posteriors do not depend on how many devices compute them, nor on whose they are."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from jax.sharding import AxisType

from boomdp_jax.core.spread import Program, is_spread, run_each, spread_over
from boomdp_jax.inference.infer import infer
from tests.inference.recordings import box_scene, free_box

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = [sys.executable, "-m", "tests.inference.mesh_program"]


def begin(num_devices: int, *arguments: object) -> subprocess.Popen:
    """Start the program with so many virtual devices, in single precision."""
    flags = os.environ.get("XLA_FLAGS", "")
    flags += f" --xla_force_host_platform_device_count={num_devices}"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    environment["JAX_CPU_COLLECTIVES_IMPLEMENTATION"] = "gloo"
    return subprocess.Popen(
        [*PROGRAM, *map(str, arguments)],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(process: subprocess.Popen) -> None:
    output, _ = process.communicate(timeout=900)
    assert process.returncode == 0, output


def read(path: Path) -> dict[int, list[np.ndarray]]:
    """Arrays by number of devices."""
    found: dict[int, list[np.ndarray]] = {}
    with np.load(path) as arrays:
        for name in arrays.files:
            found.setdefault(int(name.split(".")[0]), []).append(arrays[name])
    return found


def assert_same_bits(found: list[np.ndarray], expected: list[np.ndarray]) -> None:
    assert len(found) == len(expected) > 10
    for one, other in zip(found, expected, strict=True):
        assert one.dtype == other.dtype
        assert one.tobytes() == other.tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["rj", "smc", "nuts"])
def test_one_two_and_eight_devices_give_the_same_bits(tmp_path: Path, method: str):
    finish(begin(8, tmp_path / "out.npz", method, 0, 1, 2, 8))
    found = read(tmp_path / "out.npz")
    assert set(found) == {0, 1, 2, 8}
    for count in (1, 2, 8):
        assert_same_bits(found[count], found[0])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["rj", "nuts"])
def test_two_processes_give_the_bits_of_one(tmp_path: Path, method: str):
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        port = probe.getsockname()[1]
    pair = [
        begin(1, tmp_path / f"{place}.npz", method, 2, "--join", place, port)
        for place in (0, 1)
    ]
    for process in pair:
        finish(process)
    finish(begin(1, tmp_path / "alone.npz", method, 0))
    alone = read(tmp_path / "alone.npz")[0]
    for place in (0, 1):
        assert_same_bits(read(tmp_path / f"{place}.npz")[2], alone)


def auto_mesh(*shape: int, kind: AxisType = AxisType.Auto):
    names = ("x", "y")[: len(shape)]
    return jax.make_mesh(shape, names, (kind,) * len(shape))


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (auto_mesh(1, 1), r"mesh: expected one axis, got \('x', 'y'\)"),
        (auto_mesh(1, kind=AxisType.Explicit), "mesh: expected an axis of type Auto"),
    ],
)
def test_a_mesh_of_another_kind_is_refused(mesh, message: str):
    history = free_box(np.random.default_rng(0), 5)
    with pytest.raises(ValueError, match=message):
        infer(jax.random.key(0), box_scene(), history, mesh=mesh)
    assert not is_spread()


def test_a_mesh_returns_what_plain_arithmetic_does():
    program = Program(
        lambda shared, row, scale: (shared + row, scale), lambda x, scale: x * scale
    )
    shared = np.arange(3.0)
    inputs = [(np.full(3, float(n)), np.asarray(2.0)) for n in range(5)]
    with spread_over(auto_mesh(1)):
        assert is_spread()
        found = run_each(program, shared, inputs)
        assert run_each(program, shared, []) == []
    assert not is_spread()
    for number, value in enumerate(found):
        np.testing.assert_array_equal(value, 2.0 * (np.arange(3.0) + number))
