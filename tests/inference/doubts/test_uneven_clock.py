"""Steps that do not last as long as told: by the likelihood, by rates, on boxes."""

import numpy as np
import pytest
from scipy import optimize, stats

from boomdp_jax.core.history import make_history
from boomdp_jax.inference.blocks.block import Block
from boomdp_jax.inference.doubts.evidence_report import BlockResult
from boomdp_jax.inference.doubts.residual import ResidualCheck
from boomdp_jax.inference.doubts.residual_report import report_residuals
from boomdp_jax.inference.doubts.uneven_clock import (
    ClockError,
    clock_error,
    spread_along,
)
from tests.inference.recordings import box_scene
from tests.inference.residual_checks import check
from tests.inference.residual_worlds import box_table

STEP = 0.05


def random_rows(seed: int, sd: float, num: int = 80):
    """Innovations, rates of motion (0.1 m/s over 1 mm), steps off by some sd [s]."""
    rng = np.random.default_rng(seed)
    rate = rng.normal(size=(num, 6)) * rng.gamma(1.0, 100.0, size=(num, 1))
    off = sd * rng.standard_normal(num)
    innovation = rng.normal(size=(num, 6)) + rate * off[:, None]
    return innovation, rate, np.full(num, STEP)


@pytest.mark.parametrize("sd", [0.0, 0.01])
def test_evidence_is_that_of_the_two_normal_densities(sd):
    innovation, rate, _ = random_rows(1, sd)
    speed = np.linalg.norm(rate, axis=1)
    along = np.sum(innovation * rate, axis=1) / speed
    found = spread_along(along, speed)

    def misfit(numbers):
        spread = np.hypot(np.exp(numbers[0]), np.exp(numbers[1]) * speed)
        return -np.sum(stats.norm(0.0, spread).logpdf(along))

    best = min(
        optimize.minimize(misfit, [0.0, start], method="Nelder-Mead").fun
        for start in (-12.0, -7.0, -4.0)
    )
    alone = -np.sum(stats.norm(0.0, np.sqrt(np.mean(along**2))).logpdf(along))
    # Variances are tried in steps of a factor of 1.47.
    assert np.sum(found.gain) == pytest.approx(alone - best, abs=0.1)


def test_even_clocks_are_not_doubted():
    found = [clock_error(*random_rows(seed, 0.0)) for seed in range(400)]
    assert max(one.log_bayes_factor for one in found if one is not None) < 4.0


def test_a_gross_error_or_two_are_no_clock():
    """Two readings of 80 are off by twenty times the noise."""
    found = []
    for seed in range(200):
        innovation, rate, length = random_rows(seed, 0.0)
        innovation[[11, 61]] *= 20.0
        found.append(clock_error(innovation, rate, length))
    assert sum(one is not None and one.log_bayes_factor > 4.0 for one in found) <= 2


def test_uneven_clocks_are_found_and_measured():
    for seed in range(20):
        found = clock_error(*random_rows(seed, 0.02))
        assert found is not None
        assert found.log_bayes_factor > 4.0
        # A standard error of a sd from 80 rows is eight hundredths, and rows that are
        # slow tell little.
        assert found.sd == pytest.approx(0.02, rel=0.4)
        assert found.length == STEP


@pytest.mark.parametrize("what", ["few", "at rest", "unread"])
def test_where_nothing_tells_nothing_is_said(what):
    innovation, rate, length = random_rows(0, 0.02)
    if what == "few":
        innovation, rate, length = innovation[:12], rate[:12], length[:12]
    if what == "at rest":
        rate[:] = 0.0
    if what == "unread":
        rate[:], innovation[:] = 0.0, 0.0
    assert clock_error(innovation, rate, length) is None


@pytest.mark.parametrize("poses_only", [False, True])
def test_a_box_whose_steps_are_told_by_their_mean_alone(poses_only):
    """Pushed at random in small steps; of each row the length is 60 to 140 % of it."""
    found = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        length = STEP * rng.uniform(0.6, 1.4, 100)
        state, action, after = (x[:, None] for x in box_table(rng, 100, dt=length))
        if poses_only:
            state[..., 3:] = after[..., 3:] = np.nan
        told, mean = (make_history(state, action, after, dt) for dt in (length, STEP))
        right, wrong = (check([each])[0].clock for each in (told, mean))
        assert right is not None
        assert right.log_bayes_factor < 4.0
        assert wrong is not None
        found.append(wrong)
        # A filter takes some of one row's delay for speed in the next ones.
        assert 0.5 < wrong.sd / np.std(length - STEP) < 2.0
    # The motion is taken to be noisy, which explains some.
    assert np.sum([each.log_bayes_factor > 4.0 for each in found]) >= 3


def test_a_reason_says_by_how_much(no_type_checks):
    block = Block((0,), None, None)

    def reasons_of(clock: ClockError | None) -> list[str]:
        found = ResidualCheck(60, [], [{}], clock=clock)
        result = BlockResult(block, None, 0, found)
        return report_residuals(box_scene(), [result])[1]

    (reason,) = reasons_of(ClockError(0.02, STEP, 30.0))
    assert reason.startswith("box: what is left of its readings lies along its motion")
    assert "steps of 0.05 s were off by 0.02 s each (log Bayes factor 30)" in reason
    # What chatters on a floor; and what may be chance.
    assert reasons_of(ClockError(0.002, STEP, 30.0)) == []
    assert reasons_of(ClockError(0.02, STEP, 2.0)) == []
    assert reasons_of(None) == []
