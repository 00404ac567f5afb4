"""Whether to rely on kinds: the verdict that people, files and later calls get."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from boomdp_jax.core.history import History, make_history
from boomdp_jax.core.npz_file import read_npz, write_npz
from boomdp_jax.inference import KindsPosterior, infer_kinds, load_kinds
from boomdp_jax.inference.kinds.verdict import (
    merged_diagnostics,
    verdict_on_learnt,
    with_kind_doubts,
)
from tests.inference.kinds.test_infer_kinds import box, learnt, nothing_seen, scene
from tests.inference.made_posteriors import table_posterior
from tests.inference.recordings import DT, NOISE

GIVEN = "the kinds given were learnt with diagnostics that were not ok: "
STUCK = {
    "ok": False,
    "reasons": ["table: one chain is stuck"],
    "notes": ["not tied", "table: never in motion"],
    "r_hat": 3.1,
    "effective_sample_size": 18.0,
    "jump_acceptance": None,
    "residual": [{"bodies": ["table"], "laws": []}],
}
FINE = {
    "ok": True,
    "reasons": [],
    "notes": ["not tied", "table: nothing was read of it in any of 9 rows"],
    "r_hat": 1.01,
    "effective_sample_size": 400.0,
    "jump_acceptance": 0.2,
    "residual": [{"bodies": ["table"], "laws": []}],
}


def of_scenes(*verdicts: dict) -> KindsPosterior:
    """Kinds of one table in each scene, all of one kind."""
    num = len(verdicts)
    return KindsPosterior(
        posteriors=tuple(table_posterior(8, diagnostics=each) for each in verdicts),
        bodies=tuple((index, "table") for index in range(num)),
        kind=np.zeros((8, num), int),
        concentration=np.ones(8),
        acceptance=np.ones(num),
        kinds=learnt(),
    )


def test_the_table_ends_with_the_verdict():
    assert "\ndiagnostics   ok\nnote          not tied\n" in of_scenes(FINE).summary()
    text = of_scenes(STUCK).summary()
    assert "\ndiagnostics   NOT OK: table: one chain is stuck\n" in text


def test_of_many_reasons_the_table_has_the_first_and_says_where_all_are():
    reasons = [f"table: number {i} is stuck" for i in range(111)]
    many = STUCK | {"reasons": reasons, "notes": reasons[:4]}
    lines = of_scenes(many).summary().splitlines()
    (line,) = [line for line in lines if line.startswith("diagnostics")]
    assert line.startswith(f"diagnostics   NOT OK: {reasons[0]}; {reasons[1]}; ")
    assert line.endswith("; and 108 more in diagnostics['reasons']")
    assert lines[-1] == "note          and 1 more in diagnostics['notes']"
    assert of_scenes(many).diagnostics["reasons"] == reasons


def test_one_scene_that_is_not_ok_is_enough_whichever_it_is():
    found = of_scenes(FINE, STUCK)
    verdict = found.diagnostics
    assert not verdict["ok"]
    assert verdict["reasons"] == ["scene 1: table: one chain is stuck"]
    assert verdict["notes"] == [
        "not tied",
        "scene 0: table: nothing was read of it in any of 9 rows",
        "scene 1: table: never in motion",
    ]
    assert verdict["r_hat"] == 3.1
    assert verdict["effective_sample_size"] == 18.0
    assert verdict["jump_acceptance"] == 0.2
    assert [entry["scene"] for entry in verdict["residual"]] == [0, 1]
    assert of_scenes(FINE, FINE).diagnostics["ok"]


def test_the_report_has_the_verdict_of_all_scenes_in_numbers_that_json_holds():
    report = of_scenes(FINE, STUCK | {"r_hat": np.nan}).to_json()
    assert report["diagnostics"].keys() == FINE.keys()
    assert not report["diagnostics"]["ok"]
    assert report["diagnostics"]["r_hat"] is None
    json.dumps(report, allow_nan=False)


def test_files_of_kinds_say_whether_and_why_not(tmp_path):
    path = tmp_path / "kinds.npz"
    ok, reasons = verdict_on_learnt(STUCK, None)
    dataclasses.replace(learnt(), ok=ok, reasons=reasons).save(path)
    read = load_kinds(path)
    assert read.ok is False
    assert read.reasons == ("table: one chain is stuck",)


def test_files_of_older_versions_say_nothing(tmp_path):
    path = tmp_path / "kinds.npz"
    learnt().save(path)
    with_header(path, diagnostics=None)
    read = load_kinds(path)
    assert read.ok is None
    assert read.reasons == ()


@pytest.mark.parametrize(
    "verdict",
    [
        "ok",
        {"ok": True},
        {"ok": 1, "reasons": []},
        {"ok": False, "reasons": "stuck"},
        {"ok": False, "reasons": [1]},
    ],
)
def test_files_with_another_verdict_are_refused(tmp_path, verdict):
    path = tmp_path / "kinds.npz"
    learnt().save(path)
    with_header(path, diagnostics=verdict)
    with pytest.raises(ValueError, match="diagnostics: expected ok and a list of"):
        load_kinds(path)


def with_header(path, **changes) -> None:
    """Change fields of a file's header; None: take one out."""
    arrays = dict(read_npz(path))
    header = json.loads(arrays["header"].tobytes()) | changes
    header = {name: value for name, value in header.items() if value is not None}
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    write_npz(path, arrays)


def test_kinds_that_were_not_ok_are_no_silent_prior(tmp_path):
    """From a run to its file to a run in another room; a few draws are never ok."""
    spec = scene([box("a")], unknown={"ground": 1})
    few = {"num_chains": 2, "num_warmup": 1, "num_samples": 4}
    first = infer_kinds(jax.random.key(0), spec, nothing_seen(1), **few)
    assert not first.diagnostics["ok"]
    assert first.kinds.reasons == tuple(first.diagnostics["reasons"])
    first.save(tmp_path / "kinds.npz")
    kinds = load_kinds(tmp_path / "kinds.npz")
    again = infer_kinds(
        jax.random.key(1), spec, nothing_seen(1), prior_kinds=kinds, **few
    )
    note = again.diagnostics["notes"][0]
    assert note.startswith(GIVEN + kinds.reasons[0])
    assert note in again.summary()
    # What they taught is in the kinds learnt on top of them, too.
    assert again.kinds.reasons[-1] == note


@pytest.mark.parametrize("ok", [True, None])
def test_kinds_that_were_ok_or_of_which_nobody_knows_are_given_without_a_note(ok):
    kinds = dataclasses.replace(learnt(), ok=ok)
    found = with_kind_doubts(table_posterior(8), nothing_seen(1), [0], kinds)
    assert not any(GIVEN in note for note in found.diagnostics["notes"])
    assert verdict_on_learnt(found.diagnostics, kinds) == (ok, ())


def test_notes_on_kinds_given_do_not_change_the_verdict():
    """That the kinds learnt on top of them are not ok is for the next call."""
    kinds = dataclasses.replace(learnt(), ok=False, reasons=("a", "b", "c", "d", "e"))
    found = with_kind_doubts(table_posterior(8), nothing_seen(1), [0], kinds)
    assert found.diagnostics["ok"]
    note = GIVEN + "a; b; c; and 2 more in prior_kinds.reasons"
    assert found.diagnostics["notes"][0] == note
    assert merged_diagnostics([found, found])["notes"].count(note) == 1
    assert verdict_on_learnt(found.diagnostics, kinds) == (False, (note,))


def turning(num: int = 40, gross: int = 0, angles: bool = True) -> History:
    """A table that glides and turns; some readings of x are a metre off."""
    rng = np.random.default_rng(0)
    twist = np.array([0.2, 0.1, 0.3])
    pose = DT * np.arange(num + 1)[:, None] * twist
    read = np.concatenate([pose, np.tile(twist, (num + 1, 1))], axis=1)
    read = read + NOISE * rng.standard_normal(read.shape)
    read[5 : 5 + 5 * gross : 5, 0] += 1.0
    if not angles:
        read[:, 2] = np.nan
    return make_history(read[:-1, None], np.zeros((num, 1, 3)), read[1:, None], DT)


def doubted(history: History, at_rest: list[int]) -> dict:
    posterior = with_kind_doubts(table_posterior(8), history, at_rest, None)
    return dict(posterior.diagnostics)


def test_what_readings_tell_against_themselves_is_said_as_of_one_body_alone():
    found = doubted(turning(), [])
    assert found["ok"]
    assert found["notes"] == []
    (note,) = doubted(turning(gross=4), [])["notes"]
    assert note.startswith("table: 4 of 240 readings lie far")
    assert note.endswith("; with such, write NaN in their place")
    (reason,) = doubted(turning(angles=False), [])["reasons"]
    assert reason.startswith("table: its angle was never read")


def test_bodies_whose_readings_were_left_out_are_not_asked_about_them():
    found = doubted(turning(gross=4, angles=False), [0])
    assert found["ok"]
    assert found["notes"] == []
