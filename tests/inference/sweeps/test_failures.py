"""Sweeps with objects that inference refuses: the others are done, and it is said."""

import json
import pickle
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest

from boomdp_jax.core import make_history, save_history
from boomdp_jax.inference import SweepError
from boomdp_jax.inference.failures import listing
from boomdp_jax.inference.members import Refusals
from boomdp_jax.inference.posteriors.posterior import load_posterior
from boomdp_jax.inference.sweeps import sweep as sweeps
from boomdp_jax.inference.sweeps.sweep import begin_sweep, infer_sweep
from boomdp_jax.physics.scene_spec import scene_spec_from_dict
from tests.inference.made_posteriors import table_spec
from tests.inference.recordings import box_scene, free_box
from tests.inference.sweeps.test_sweep import (
    KEY,
    assert_same_arrays,
    cheap_batch,
    recordings,
)

BAD_DT = 0.5


def refused_batch(key, specs, histories, **options):
    """Cheap posteriors; recordings of a certain step length are refused."""
    refusals = Refusals(len(specs))
    for place, history in enumerate(histories):
        with refusals.of(place):
            if float(history.dt[0]) == BAD_DT:
                raise ValueError(f"too slow: {int(np.sum(history.mask))} rows")
    refusals.check()
    return cheap_batch(key, specs, histories, **options)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list:
    """Put `refused_batch` in place of inference; sizes of the calls."""
    sizes = []

    def count(*arguments, **options):
        sizes.append(len(arguments[1]))
        return refused_batch(*arguments, **options)

    monkeypatch.setattr(sweeps, "infer_batch", count)
    return sizes


def bad(num_rows: int):
    """A recording that is refused."""
    state, action = np.zeros((num_rows, 1, 6)), np.zeros((num_rows, 1, 3))
    return make_history(state, action, state, BAD_DT)


def with_bad(*numbers: int, num: int = 8) -> list:
    return [bad(20 + n) if n in numbers else h for n, h in enumerate(recordings(num))]


def sweep_all(folder: Path, histories: list, **options) -> list[Path]:
    options = {"batch": 3} | options
    return infer_sweep(jax.random.key(KEY), table_spec(), histories, folder, **options)


def test_others_are_done_then_it_is_raised(tmp_path: Path, calls: list):
    with pytest.raises(SweepError) as caught:
        sweep_all(tmp_path, with_bad(1, 3, 4, 5))
    assert calls == [3, 2, 3, 2]
    error = caught.value
    assert error.failed == {
        n: f"object {n}: too slow: {20 + n} rows" for n in (1, 3, 4, 5)
    }
    names = [f"object-{n:06d}.npz" for n in (0, 2, 6, 7)]
    assert [path.name for path in error.paths] == names
    assert sorted(path.name for path in tmp_path.glob("object-*")) == names
    for path in error.paths:
        assert load_posterior(path).seed == KEY
    assert str(error).startswith(
        f"{tmp_path}: expected posteriors of 8 objects, got 4; the others were "
        "refused: object 1: too slow: 21 rows; object 3: too slow"
    )
    record = json.loads((tmp_path / "unit-000000.json").read_text())
    assert record["failed"] == {"1": "object 1: too slow: 21 rows"}
    assert list(record["files"]) == names[:2]
    assert "failed" not in json.loads((tmp_path / "unit-000002.json").read_text())
    sent = pickle.loads(pickle.dumps(error))
    assert (sent.failed, sent.paths) == (error.failed, error.paths)


def test_to_resume_repeats_nothing_and_says_the_same(tmp_path: Path, calls: list):
    said = []
    for _ in range(2):
        with pytest.raises(SweepError) as caught:
            sweep_all(tmp_path, with_bad(1))
        said.append(str(caught.value))
    assert said[0] == said[1]
    assert calls == [3, 2, 3, 2]
    with pytest.raises(SweepError, match="object 1: too slow"):
        sweep_all(tmp_path, with_bad(1), shard=(0, 2))
    assert len(sweep_all(tmp_path, with_bad(1), shard=(1, 2))) == 3


def test_bits_depend_on_no_order_of_events(tmp_path: Path, calls: list):
    histories = with_bad(1, 5)
    with pytest.raises(SweepError):
        sweep_all(tmp_path / "whole", histories)
    sweep = begin_sweep(
        jax.random.key(KEY), table_spec(), histories, tmp_path / "parts", batch=3
    )
    for unit in (2, 1):
        assert sweep.run(unit)
        assert not sweep.run(unit)
    # As when killed between the files and the record, and hurt since.
    sweep.run(0)
    (sweep.folder / "unit-000000.json").unlink()
    sweep.paths(1)[0].write_bytes(b"")
    assert [sweep.is_done(unit) for unit in range(3)] == [False, False, True]
    with pytest.raises(SweepError):
        sweep_all(sweep.folder, histories)
    assert_same_arrays(tmp_path / "whole", sweep.folder, 6)
    assert sweep.failed(1) == {5: "object 5: too slow: 25 rows"}
    assert [path.name for path in sweep.paths(0)] == [
        "object-000000.npz",
        "object-000002.npz",
    ]


def test_what_is_left_of_another_try_is_removed(tmp_path: Path, calls: list):
    sweep = begin_sweep(jax.random.key(KEY), table_spec(), with_bad(1), tmp_path)
    left = [tmp_path / "object-000001.npz", tmp_path / ".object-000001.npz.0a.part"]
    for path in left:
        path.write_bytes(b"old")
    sweep.run(0)
    assert not any(path.exists() for path in left)


def test_a_bad_recording_that_is_mended_is_taken_up(tmp_path: Path, calls: list):
    """Its unit comes to what it would have been; one that was good stays refused."""
    files = [tmp_path / f"{number}.npz" for number in range(4)]
    for path, history in zip(files, with_bad(3, num=4), strict=True):
        save_history(path, history)
    folder = tmp_path / "out"
    assert len(sweep_all(folder, files, batch=2, shard=(0, 2))) == 2
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        with pytest.raises(SweepError, match=rf"refused: {files[3]}: too slow: 23"):
            sweep_all(folder, files, batch=2, shard=(1, 2))
    # Said when the shard begins, and not again when its turn comes.
    (warning,) = warned
    assert "overrides the scene's" in str(warning.message)
    save_history(files[3], recordings(4)[3])
    num_calls = len(calls)
    found = sweep_all(folder, files, batch=2)
    assert calls[num_calls:] == [2]
    expected = sweep_all(tmp_path / "at once", files, batch=2)
    assert [path.name for path in found] == [path.name for path in expected]
    assert_same_arrays(folder, tmp_path / "at once", 4)
    (folder / "unit-000000.json").unlink()
    save_history(files[3], recordings(4)[2])
    num_calls = len(calls)
    with pytest.raises(ValueError, match=r"unit-000001.json: inputs: object 3 .*3.npz"):
        sweep_all(folder, files, batch=2)
    assert len(calls) == num_calls


def test_other_errors_than_refusals_are_raised_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def broken(*arguments, **options):
        raise ValueError("a mistake of this library")

    monkeypatch.setattr(sweeps, "infer_batch", broken)
    with pytest.raises(ValueError, match="a mistake of this library"):
        sweep_all(tmp_path, with_bad())
    assert not list(tmp_path.glob("unit-*"))


def test_a_unit_that_the_sweep_does_not_have_is_refused(tmp_path: Path, calls: list):
    sweep = begin_sweep(jax.random.key(KEY), table_spec(), recordings(2), tmp_path)
    with pytest.raises(ValueError, match="unit: expected one that the sweep has"):
        sweep.run(1)
    assert not list(tmp_path.glob("unit-*"))


def test_all_bad_files_are_named_before_the_work(tmp_path: Path, calls: list):
    files = [tmp_path / f"{number}.npz" for number in range(14)]
    save_history(files[0], recordings(1)[0])
    for path in files[1:]:
        path.write_bytes(b"no recording")
    folder = tmp_path / "out"
    with pytest.raises(ValueError) as caught:
        sweep_all(folder, files)
    text = str(caught.value)
    assert "got 13 of 14 files that do not: " in text
    assert all(f"{path}: " in text for path in files[1:11])
    assert f"{files[11]}" not in text
    assert text.endswith("; and 3 more")
    # One of them is said as it always was, and so are those of another shard.
    with pytest.raises(ValueError, match=rf"^{files[1]}: "):
        sweep_all(folder, files[:2])
    files[2].unlink()
    with pytest.raises(ValueError, match=rf"{files[2]}: No such file or directory; "):
        sweep_all(folder, files[:4])
    for path in files[1:]:
        path.unlink(missing_ok=True)
    with pytest.raises(OSError, match=r"got 2 of 3 files .*1.npz: No such file.*2.npz"):
        sweep_all(folder, files[:3])
    assert not folder.exists()
    assert sweep_all(folder, files, batch=1, shard=(0, 14))


def test_all_recordings_in_memory_that_do_not_fit_are_named(tmp_path: Path):
    state, action = np.zeros((3, 2, 6)), np.zeros((3, 2, 3))
    two = make_history(state, action, state, 0.02)
    with pytest.raises(ValueError, match=r"got 2 of 3 .*object 0: .*; object 2: .*"):
        sweep_all(tmp_path / "out", [two, recordings(1)[0], two])
    with pytest.raises(ValueError, match=r"^object 1: .*expected 1 bodies, got 2"):
        sweep_all(tmp_path / "out", [recordings(1)[0], two])
    with pytest.raises(ValueError, match=r"^(?!object).*expected 1 bodies, got 2"):
        sweep_all(tmp_path / "out", [two])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"unknown": {"revolute": 20, "wheel": 20}}, "unknown: 40 constraints of a"),
        ({"prior": {"density": {"spread": -1}}}, "prior: density: expected a finite"),
    ],
)
def test_a_scene_that_can_never_be_inferred_leaves_no_folder(
    tmp_path: Path, changes, message: str
):
    good = table_spec()
    wrong = scene_spec_from_dict(good.to_dict() | changes)
    key, histories, folder = jax.random.key(KEY), recordings(3), tmp_path / "out"
    with pytest.raises(ValueError, match=rf"^(?!object).*{message}"):
        begin_sweep(key, wrong, histories, folder)
    with pytest.raises(ValueError, match=rf"^object 1: .*{message}"):
        begin_sweep(key, [good, wrong, wrong], histories, folder)
    assert not folder.exists()


def test_a_structure_that_is_given_asks_nothing_of_others(tmp_path: Path):
    wide = table_spec().to_dict() | {"unknown": {"revolute": 20, "wheel": 20}}
    options = {"method": "nuts", "structure": {"table": ["wheel"]}}
    spec = scene_spec_from_dict(wide)
    begin_sweep(jax.random.key(KEY), spec, recordings(1), tmp_path / "out", **options)


def test_a_list_is_at_most_ten_long():
    assert listing(["a", "b"]) == "a; b"
    assert listing(list("abcdefghijkl")) == "a; b; c; d; e; f; g; h; i; j; and 2 more"


@pytest.mark.slow
def test_inference_itself_refuses_one_and_does_the_others(tmp_path: Path):
    histories = [free_box(np.random.default_rng(n), 9 + n) for n in range(3)]
    unread = np.asarray(histories[1].state).copy()
    unread[..., 3:] = np.nan
    still = np.zeros((len(unread), 1, 3))
    histories[1] = make_history(unread, still, unread, 0.02)
    options = {"method": "laplace", "likelihood": "one-step"}
    with pytest.raises(SweepError, match=r"object 1: .*a reading of every") as done:
        infer_sweep(
            jax.random.key(0), box_scene({}), histories, tmp_path, batch=2, **options
        )
    assert list(done.value.failed) == [1]
    for path in done.value.paths:
        mass = load_posterior(path).to_json()["bodies"]["box"]["mass"]
        assert abs(mass["mean"] - 3.0) < 5 * mass["sd"]
