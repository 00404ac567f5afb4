"""Corrections of a body's motion that go one way, and such that do not."""

import numpy as np
import pytest

from boomdp_jax.inference.blocks.block import make_block
from boomdp_jax.inference.doubts.corrections import (
    Persistence,
    persistence,
    persistence_by_body,
    unmoved_reason,
)
from boomdp_jax.inference.doubts.evidence_report import BlockResult
from boomdp_jax.inference.doubts.residual import ResidualCheck
from boomdp_jax.inference.doubts.residual_report import report_residuals
from tests.inference import residual_worlds as worlds
from tests.inference.residual_checks import known_boxes

RUN = np.arange(140) // 70


@pytest.mark.parametrize("freedom", [np.inf, 3.0])
def test_white_corrections_add_up_to_no_more(freedom):
    """Normal and heavy-tailed ones, 500 times: none would be noted.

    The mean of the ratio is one, up to what sums over a window share.
    """
    rng = np.random.default_rng(1)
    found = []
    for _ in range(500):
        values = rng.normal(size=(140, 2))
        if np.isfinite(freedom):
            values /= np.sqrt(rng.chisquare(freedom, size=(140, 1)) / freedom)
        found.append(persistence(values, RUN))
    ratio, score = np.array(found, float).T
    assert abs(ratio.mean() - 1.0) < 5.0 * ratio.std() / np.sqrt(500)
    assert not np.any((ratio > 3.0) & (score > 6.0))


def test_the_ratio_is_the_one_of_sums_over_windows():
    """Of equal corrections it is the number of rows, but for the ends of runs.

    A window that reaches beyond an end holds fewer.
    """
    found = persistence(np.ones((140, 1)), RUN)
    assert found is not None
    # All windows of 20 rows of each run of 70, those that reach beyond it included.
    lengths = [min(i + 20, 70) - max(i, 0) for i in range(-19, 70)]
    expected = np.sum(np.square(lengths)) / np.sum(lengths)
    np.testing.assert_allclose(found.ratio, expected)


def test_what_is_corrected_back_adds_up_to_less():
    """As errors of readings that last for some rows are."""
    rng = np.random.default_rng(2)
    error = np.convolve(rng.normal(size=144), np.ones(5), mode="valid")[:, None]
    found = persistence(np.diff(error, axis=0, append=0.0), RUN)
    assert found is not None
    assert found.ratio < 0.5


def test_few_rows_and_no_corrections_say_nothing():
    assert persistence(np.ones((59, 1)), np.zeros(59, int)) is None
    assert persistence(np.zeros((140, 1)), RUN) is None
    assert persistence(np.full((140, 1), np.nan), RUN) is None


def test_second_readings_of_an_instant_count_with_the_first():
    """They undo here what the first ones did, but not across runs."""
    last = np.zeros((140, 1, 6))
    last[:, :, 3:5] = 1.0
    first = -last
    (found,) = persistence_by_body(first, last, RUN)
    assert found == {}
    (found,) = persistence_by_body(0.0 * first, last, RUN)
    assert set(found) == {"velocity"}


@pytest.mark.parametrize(
    ("ratio", "score", "is_note"), [(4.0, 7.0, True), (4.0, 5.0, False), (2, 7, False)]
)
def test_corrections_that_go_one_way_are_a_note(ratio, score, is_note):
    spec = known_boxes()
    history = worlds.record_box(np.random.default_rng(3), 20)
    found = ResidualCheck(
        20,
        [],
        [{}],
        persistence=({"spin": Persistence(float(ratio), score)},),
        by_chance=(0.1,),
    )
    result = BlockResult(make_block(spec, (0,), history), None, 0, found)
    (entry,), reasons, notes = report_residuals(spec, [result])
    assert entry["persistence"]["box0"]["spin"]["ratio"] == ratio
    assert reasons == []
    assert len(notes) == is_note
    assert all("correct its spin the same way" in note for note in notes)


@pytest.mark.parametrize(
    ("by_chance", "ratio", "score", "is_reason"),
    [
        (3.0, 4.0, 5.0, True),
        # Real disturbances, and a few rows that happen to agree.
        (3.0, 1.2, 5.0, False),
        (3.0, 4.0, 2.0, False),
        # Pushes do most of it.
        (0.2, 4.0, 5.0, False),
    ],
)
def test_motion_that_does_not_follow_wrenches_is_a_doubt(
    by_chance, ratio, score, is_reason
):
    found = {"velocity": Persistence(ratio, score)}
    reason = unmoved_reason("box0", found, by_chance)
    assert (reason is not None) == is_reason
    assert unmoved_reason("box0", {}, by_chance) is None
    spec = known_boxes()
    history = worlds.record_box(np.random.default_rng(4), 20)
    check = ResidualCheck(20, [], [{}], persistence=(found,), by_chance=(by_chance,))
    result = BlockResult(make_block(spec, (0,), history), None, 0, check)
    (entry,), reasons, notes = report_residuals(spec, [result])
    assert entry["by_chance"] == {"box0": by_chance}
    assert reasons == ([reason] if is_reason else [])
    assert notes == []
