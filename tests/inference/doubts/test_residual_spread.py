"""Errors that grow with speed: against SciPy's rank correlation, and by rates."""

import numpy as np
import pytest
from scipy import stats

from boomdp_jax.inference.blocks.block import Block
from boomdp_jax.inference.doubts.evidence_report import BlockResult
from boomdp_jax.inference.doubts.residual import ResidualCheck
from boomdp_jax.inference.doubts.residual_report import report_residuals
from boomdp_jax.inference.doubts.residual_spread import spread_growth
from tests.inference.recordings import box_scene


def random_rows(seed: int, growth: float, num: int = 60):
    """Innovations, counts and twists; sizes go with a power of the speed."""
    rng = np.random.default_rng(seed)
    twist = rng.normal(size=(num, 3)) * rng.gamma(1.0, size=(num, 1))
    speed = np.hypot(np.hypot(twist[:, 0], twist[:, 1]), 0.2 * twist[:, 2])
    innovation = rng.normal(size=(num, 6)) * speed[:, None] ** growth
    return innovation, np.ones((num, 6)), twist


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("growth", [0.0, 0.3])
def test_ranks_agree_as_scipy_has_it(seed, growth):
    innovation, counts, twist = random_rows(seed, growth)
    found = spread_growth(innovation, counts, twist, 0.2)
    assert found is not None
    size = np.sum(innovation[:, 3:] ** 2, axis=1)
    speed = np.hypot(np.hypot(twist[:, 0], twist[:, 1]), 0.2 * twist[:, 2])
    expected = stats.spearmanr(size, speed, alternative="greater")
    assert np.log(found.p_value) == pytest.approx(np.log(expected.pvalue), rel=0.1)


def test_errors_that_do_not_grow_are_said_to_as_often_as_stated():
    """Of 400 recordings; the binomial's bound is passed once in 1,000 times."""
    found = [spread_growth(*random_rows(seed, 0.0), 0.2) for seed in range(400)]
    values = np.array([one.p_value for one in found if one is not None])
    assert len(values) == 400
    for rate in (0.5, 0.1, 0.02):
        num = np.sum(values < rate)
        low, high = stats.binom(400, rate).ppf([5e-4, 1 - 5e-4])
        assert low <= num <= high


def test_errors_that_grow_are_found_and_measured():
    for seed in range(20):
        found = spread_growth(*random_rows(seed, 1.0), 0.2)
        assert found is not None
        assert found.p_value < 1e-4
        assert found.fast > 3.0 * found.slow


def test_poses_do_where_no_twist_was_read():
    innovation, counts, twist = random_rows(0, 1.0)
    alone = np.roll(innovation, 3, axis=1)
    counts[:, 3:] = 0.0
    found = spread_growth(alone * counts, counts, twist, 0.2)
    expected = spread_growth(innovation, np.roll(counts, 3, axis=1), twist, 0.2)
    assert found == expected


@pytest.mark.parametrize("what", ["few", "unread", "at rest"])
def test_where_nothing_tells_nothing_is_said(what):
    innovation, counts, twist = random_rows(0, 1.0, 19 if what == "few" else 60)
    if what == "unread":
        counts[:] = 0.0
    if what == "at rest":
        twist[:] = 0.0
    assert spread_growth(innovation, counts, twist, 0.2) is None


def test_a_note_says_by_how_much(no_type_checks):
    growth = spread_growth(*random_rows(0, 1.0), 0.2)
    assert growth is not None
    check = ResidualCheck(60, [], [{}], (growth,))
    block = Block((0,), None, None)
    result = BlockResult(block, None, 0, check)
    entries, reasons, notes = report_residuals(box_scene(), [result])
    assert reasons == []
    (note,) = notes
    assert note.startswith("box: its readings err more the faster it moves, ")
    assert f"{growth.slow:.2g} times as much as expected where it is slow" in note
    assert entries[0]["spread"]["box"]["fast"] == growth.fast
    calm = spread_growth(*random_rows(0, 0.0), 0.2)
    result = result._replace(residual=check._replace(growth=(calm,)))
    assert report_residuals(box_scene(), [result])[2] == []
    # Less than was expected everywhere, and one gross error while it is slow.
    for odd in (
        growth._replace(slow=0.006, fast=0.013),
        growth._replace(slow=3.8, fast=1.7),
    ):
        result = result._replace(residual=check._replace(growth=(odd,)))
        assert report_residuals(box_scene(), [result])[2] == []
