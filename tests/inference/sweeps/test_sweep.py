"""Sweeps: killed and resumed, in shards, after damage: always the same arrays."""

import dataclasses
import functools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core import make_history, save_history
from boomdp_jax.core.json_file import read_json
from boomdp_jax.core.npz_file import read_npz
from boomdp_jax.inference.posteriors.posterior import Posterior, load_posterior
from boomdp_jax.inference.sweeps import sweep as sweeps
from boomdp_jax.inference.sweeps.inputs import roomy
from boomdp_jax.inference.sweeps.sweep import begin_sweep, infer_sweep
from boomdp_jax.physics.scene_spec import scene_spec_from_dict
from tests.inference.made_posteriors import table_posterior, table_spec
from tests.inference.recordings import box_scene, free_box
from tests.inference.sweep_program import NUM_OBJECTS

ROOT = Path(__file__).resolve().parents[3]
KEY = 7


@functools.cache
def few_draws() -> Posterior:
    whole = table_posterior(num_draws=8)
    few = jax.tree.map(lambda leaf: leaf[:8], whole.prior_params)
    return dataclasses.replace(
        whole, prior_params=few, prior_noise_scale=whole.prior_noise_scale[:8]
    )


def cheap_batch(key, specs, histories, *, progress=False, **options):
    """Posteriors that depend on key, place and recording, without inference."""
    found, base = [], few_draws()
    for place, (spec, history) in enumerate(zip(specs, histories, strict=True)):
        draw = float(jax.random.uniform(jax.random.fold_in(key, place)))
        total = float(jnp.sum(history.action)) + history.capacity
        found.append(
            dataclasses.replace(base, log_evidence=jnp.asarray(draw + total), spec=spec)
        )
    return found


@pytest.fixture
def cheap(monkeypatch: pytest.MonkeyPatch) -> list:
    """Put cheap posteriors in place of inference; the list counts the calls."""
    calls = []

    def count(*arguments, **options):
        calls.append(len(arguments[1]))
        return cheap_batch(*arguments, **options)

    monkeypatch.setattr(sweeps, "infer_batch", count)
    return calls


def recordings(num: int = 7) -> list:
    return [free_box(np.random.default_rng(n), 5 + n) for n in range(num)]


def begin(folder: Path, histories=None, **options):
    histories = recordings() if histories is None else histories
    options = {"batch": 3} | options
    return begin_sweep(jax.random.key(KEY), table_spec(), histories, folder, **options)


def run_all(sweep, units) -> None:
    for unit in units:
        sweep.run(unit)


def arrays_of(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """All arrays of all posteriors but the header, which holds times."""
    found = {}
    for path in sorted(folder.glob("object-*.npz")):
        found[path.name] = read_npz(path)
        del found[path.name]["header"]
    return found


def assert_same_arrays(one: Path, other: Path, num_objects: int) -> None:
    left, right = arrays_of(one), arrays_of(other)
    assert left.keys() == right.keys()
    assert len(left) == num_objects
    for name in left:
        assert left[name].keys() == right[name].keys()
        for key, array in left[name].items():
            assert array.tobytes() == right[name][key].tobytes(), (name, key)


@pytest.mark.slow
def test_shards_together_are_one_run(tmp_path: Path, cheap: list):
    spec, histories = table_spec(), recordings()
    key = jax.random.key(KEY)
    whole = infer_sweep(key, spec, histories, tmp_path / "whole", batch=3)
    assert [path.name for path in whole] == [f"object-{n:06d}.npz" for n in range(7)]
    assert cheap == [3, 3, 1]
    parts = [
        infer_sweep(key, spec, histories, tmp_path / "parts", batch=3, shard=(i, 2))
        for i in (1, 0)
    ]
    assert [len(part) for part in parts] == [3, 4]
    assert_same_arrays(tmp_path / "whole", tmp_path / "parts", 7)
    assert load_posterior(whole[4]).seed == KEY


def test_a_single_recording_is_a_list_of_one(tmp_path: Path, cheap: list):
    path = tmp_path / "pushes.npz"
    save_history(path, recordings(1)[0])
    for name, one in {"file": str(path), "path": path, "own": recordings(1)[0]}.items():
        found = infer_sweep(jax.random.key(KEY), table_spec(), one, tmp_path / name)
        assert [file.name for file in found] == ["object-000000.npz"]
    assert cheap == [1, 1, 1]


def test_what_is_there_is_not_done_again(tmp_path: Path, cheap: list):
    sweep = begin(tmp_path)
    assert [sweep.run(unit) for unit in sweep.units()] == [True, True, True]
    assert [begin(tmp_path).run(unit) for unit in sweep.units()] == [False] * 3
    assert len(cheap) == 3


@pytest.mark.parametrize("damage", ["cut", "flip", "remove", "record", "no record"])
def test_a_damaged_unit_is_done_again(tmp_path: Path, cheap: list, damage: str):
    run_all(begin(tmp_path / "whole"), range(3))
    sweep = begin(tmp_path / "hurt")
    run_all(sweep, range(3))
    path, record = sweep.paths(1)[1], sweep.folder / "unit-000001.json"
    content = path.read_bytes()
    if damage == "cut":
        path.write_bytes(content[:-100])
    elif damage == "flip":
        middle = len(content) // 2
        flipped = bytes([content[middle] ^ 1])
        path.write_bytes(content[:middle] + flipped + content[middle + 1 :])
    elif damage == "remove":
        path.unlink()
    elif damage == "record":
        record.write_text(record.read_text()[:40])
    else:
        # As when killed between two files, the second half written.
        record.unlink()
        (path.parent / f".{path.name}.012345abcdef.part").write_bytes(content[:50])
    assert [sweep.is_done(unit) for unit in range(3)] == [True, False, True]
    run_all(sweep, range(3))
    assert cheap == [3, 3, 1] * 2 + [3]
    assert_same_arrays(tmp_path / "whole", tmp_path / "hurt", 7)
    assert not list(sweep.folder.glob(".*.part"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"method": "smc"}, 'method: expected "auto", as the folder .* got "smc"'),
        ({"num_samples": 9}, "num_samples: expected 500, as the folder"),
        ({"batch": 2}, "batch: expected 3, as the folder"),
        ({"histories": recordings(6)}, "num_objects: expected 7, as the folder"),
        ({"structure": {"table": ["wheel"]}}, "structure: expected null, as"),
    ],
)
def test_a_folder_begun_otherwise_is_refused(tmp_path: Path, changes, message: str):
    begin(tmp_path)
    begin(tmp_path)
    with pytest.raises(ValueError, match=rf"sweep\.json: {message}"):
        begin(tmp_path, **changes)


def test_another_seed_or_version_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    begin(tmp_path)
    with pytest.raises(ValueError, match=r"seed: expected 7, .* got 8; choose another"):
        begin_sweep(jax.random.key(8), table_spec(), recordings(), tmp_path, batch=3)
    versions = json.loads((tmp_path / "sweep.json").read_text())["versions"]
    monkeypatch.setattr(sweeps, "library_versions", lambda: versions | {"jax": "0"})
    with pytest.raises(ValueError, match=r"versions\.jax: expected"):
        begin(tmp_path)


def test_a_folder_of_before_outliers_had_a_choice_goes_on(tmp_path: Path):
    begin(tmp_path)
    manifest = json.loads((tmp_path / "sweep.json").read_text())
    assert manifest.pop("outliers") == "none"
    # Nor did scenes.
    assert manifest.pop("scenes")
    (tmp_path / "sweep.json").write_text(json.dumps(manifest))
    begin(tmp_path)
    with pytest.raises(ValueError, match=r'outliers: expected "none", .*"student-t"'):
        begin(tmp_path, outliers="student-t")


def test_a_shard_with_another_scene_is_refused(tmp_path: Path):
    begin(tmp_path)
    given = table_spec().to_dict()
    given["bodies"][0]["density"] = 1.0
    other = scene_spec_from_dict(given)
    with pytest.raises(ValueError, match=r"sweep\.json: scenes: expected .* choose"):
        begin_sweep(jax.random.key(KEY), other, recordings(), tmp_path, batch=3)


def test_another_recording_is_refused_and_named(tmp_path: Path, cheap: list):
    files = []
    for number, history in enumerate(recordings(2)):
        files.append(tmp_path / f"{number}.npz")
        save_history(files[-1], history)
    folder = tmp_path / "out"
    sweep = begin(folder, files)
    sweep.run(0)
    assert sweep.is_done(0)
    save_history(files[1], recordings(3)[2])
    with pytest.raises(ValueError, match=r"unit-000000.json: inputs: object 1 .*1.npz"):
        sweep.run(0)


def test_results_may_be_asked_not_to_be_there(tmp_path: Path, cheap: list):
    arguments = (jax.random.key(KEY), table_spec(), recordings(), tmp_path)
    infer_sweep(*arguments, batch=3, shard=(1, 3))
    infer_sweep(*arguments, batch=3, shard=(0, 3), resume=False)
    with pytest.raises(ValueError, match="expected no results of unit 0 yet, got some"):
        infer_sweep(*arguments, batch=3, resume=False)


@pytest.mark.parametrize("shard", [(2, 2), (-1, 2), (0, 0)])
def test_a_shard_that_does_not_exist_is_refused(tmp_path: Path, shard):
    with pytest.raises(ValueError, match=r"shard: expected \(i, n\) with 0 <= i < n"):
        begin(tmp_path).units(shard)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"method": "guess"}, "method: expected one of auto"),
        ({"outliers": "gross"}, "outliers: expected one of none, student-t; got"),
        ({"batch": 0}, "batch: expected at least 1, got 0"),
        ({"histories": []}, "histories: expected at least one, got none"),
    ],
)
def test_bad_arguments_leave_no_folder(tmp_path: Path, changes, message: str):
    with pytest.raises(ValueError, match=message):
        begin(tmp_path / "out", **changes)
    assert not (tmp_path / "out").exists()


BAD_OPTIONS = [
    ({"num_samples": 0}, "num_samples: expected at least 1, got 0"),
    ({"num_chains": 1.5}, "num_chains: expected a whole number, at least 1, got 1.5"),
    ({"num_warmup": -1}, "num_warmup: expected at least 0, got -1"),
    ({"batch": 2.5}, "batch: expected a whole number, at least 1, got 2.5"),
    ({"structure": {"table": []}}, "structure: expected none with method 'auto'"),
    ({"method": "nuts", "structure": {"chair": []}}, "expected a body that can move"),
    ({"method": "svi", "outliers": "student-t"}, "outliers: expected none with"),
    ({"num_rows": 3}, "num_rows: of files: expected None .* got 3"),
    ({"histories": ["no.npz"]}, r"No such file or directory: 'no\.npz'"),
    ({"shard": (2, 2)}, r"shard: expected \(i, n\) .* got \(2, 2\)"),
    ({"shard": 3}, r"shard: expected \(i, n\) with 0 <= i < n, got 3"),
]


@pytest.mark.parametrize(("changes", "message"), BAD_OPTIONS)
def test_a_mistake_leaves_no_folder_that_refuses_what_was_meant(
    tmp_path: Path, no_type_checks, changes, message: str
):
    options = {
        "key": jax.random.key(KEY),
        "specs": table_spec(),
        "histories": recordings(),
        "out_dir": tmp_path / "out",
    }
    with pytest.raises((ValueError, OSError), match=message):
        infer_sweep(**(options | changes))
    assert not (tmp_path / "out").exists()


def test_a_recording_of_other_bodies_leaves_no_folder(tmp_path: Path):
    (one,) = recordings(1)
    state, action = (np.repeat(np.asarray(x), 2, 1) for x in (one.state, one.action))
    two = make_history(state, action, state, 0.02)
    with pytest.raises(ValueError, match="history: expected 1 bodies, got 2"):
        begin(tmp_path / "out", [one, two])
    assert not (tmp_path / "out").exists()


def test_a_shard_needs_no_files_of_others(tmp_path: Path, cheap: list):
    path = tmp_path / "0.npz"
    save_history(path, recordings(1)[0])
    files, key = [path, tmp_path / "1.npz"], jax.random.key(KEY)
    folder, options = tmp_path / "out", {"batch": 1, "num_rows": 3}
    infer_sweep(key, table_spec(), files, folder, shard=(0, 2), **options)
    assert cheap == [1]
    with pytest.raises(FileNotFoundError, match=r"1\.npz"):
        infer_sweep(key, table_spec(), files, folder, shard=(1, 2), **options)


def test_a_file_that_is_no_manifest_is_refused(tmp_path: Path):
    (tmp_path / "sweep.json").write_text("[1, 2")
    with pytest.raises(ValueError, match=r"sweep.json: expected JSON"):
        begin(tmp_path)
    (tmp_path / "sweep.json").write_text('{"schema": "other"}')
    with pytest.raises(ValueError, match=r"sweep.json: schema: expected 'boomdp-sw"):
        read_json(tmp_path / "sweep.json", sweeps.SCHEMA)


def test_lengths_are_few_and_at_most_half_as_long_again():
    lengths = np.array([roomy(n) for n in range(1, 1000)])
    numbers = np.arange(1, 1000)
    assert (lengths >= numbers).all()
    assert (lengths[4:] < 1.5 * numbers[4:]).all()
    assert len(set(lengths.tolist())) == 17


@pytest.mark.slow
def test_a_killed_run_is_resumed_to_the_same_bits(tmp_path: Path):
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache")}
    program = [sys.executable, "-m", "tests.inference.sweep_program"]

    def start(*arguments: object) -> subprocess.Popen:
        command = [*program, *map(str, arguments)]
        return subprocess.Popen(command, cwd=ROOT, env=environment)

    def finish(*arguments: object) -> None:
        assert start(*arguments).wait(600) == 0

    finish(tmp_path / "whole")
    killed, first = tmp_path / "killed", tmp_path / "killed" / "unit-000000.json"
    process = start(killed)
    deadline = time.monotonic() + 600
    while not first.exists():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.002)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait(60) == -signal.SIGKILL
    assert 1 <= len(list(killed.glob("unit-*.json"))) < NUM_OBJECTS // 2
    finish(killed)
    assert_same_arrays(tmp_path / "whole", killed, NUM_OBJECTS)
    finish(tmp_path / "shards", 1, 2)
    assert len(arrays_of(tmp_path / "shards")) == NUM_OBJECTS // 2
    finish(tmp_path / "shards", 0, 2)
    assert_same_arrays(tmp_path / "whole", tmp_path / "shards", NUM_OBJECTS)


@pytest.mark.slow
def test_a_sweep_finds_what_single_inference_does(tmp_path: Path):
    """The mass of a free box: 3 kg, within five posterior standard deviations."""
    histories = [free_box(np.random.default_rng(n), 9 + n) for n in range(3)]
    files = infer_sweep(
        jax.random.key(0), box_scene({}), histories, tmp_path, batch=2, method="laplace"
    )
    for path in files:
        mass = load_posterior(path).to_json()["bodies"]["box"]["mass"]
        assert abs(mass["mean"] - 3.0) < 5 * mass["sd"]
        assert mass["sd"] < 0.1
