"""Numbers for people, against NumPy and closed forms."""

import json
import math

import numpy as np
import pytest

from boomdp_jax.inference.posteriors.summary import (
    axial_mean,
    plain,
    summarise,
    weighted_quantiles,
)

LEVELS = (0.05, 0.5, 0.95)


def equal(num: int) -> np.ndarray:
    return np.full(num, 1.0 / num)


def test_equal_weights_give_hazens_quantiles():
    draws = np.random.default_rng(0).normal(size=(301, 3))
    ours = weighted_quantiles(draws, equal(301), LEVELS)
    np.testing.assert_allclose(
        ours, np.quantile(draws, LEVELS, axis=0, method="hazen"), atol=1e-13
    )


def test_a_weight_counts_as_so_many_draws():
    generator = np.random.default_rng(1)
    draws, counts = generator.normal(size=200), generator.integers(1, 6, 200)
    repeated = np.repeat(draws, counts)
    ours = summarise(draws, counts / counts.sum(), 10.0 * generator.normal(size=500))
    assert ours["mean"] == pytest.approx(repeated.mean(), abs=1e-12)
    assert ours["sd"] == pytest.approx(repeated.std(), rel=1e-12)
    spacing = np.diff(np.sort(draws)).max()
    for name, level in (("q05", 0.05), ("q50", 0.5), ("q95", 0.95)):
        assert ours[name] == pytest.approx(np.quantile(repeated, level), abs=spacing)


@pytest.mark.parametrize(("scale", "expected"), [(0.70, True), (0.715, False)])
def test_half_of_the_prior_variance_is_the_border(scale, expected):
    prior = np.random.default_rng(2).normal(size=1000)
    assert (scale**2 < 0.5) is expected
    ours = summarise(scale * prior, equal(1000), prior)
    assert ours["identified"] is expected
    source = scale * prior if expected else prior
    assert ours["sd"] == pytest.approx(source.std(), rel=1e-12)
    assert ours["q95"] == pytest.approx(
        np.quantile(source, 0.95, method="hazen"), rel=1e-12
    )


def test_a_scale_parameter_is_judged_by_its_logarithm():
    # The spread of the logarithm is the prior's; that of the value is far smaller.
    prior = np.exp(np.random.default_rng(3).normal(size=1000))
    ours = summarise(0.01 * prior, equal(1000), prior, "log")
    assert ours["identified"] is False
    assert summarise(0.01 * prior, equal(1000), prior)["identified"] is True


@pytest.mark.parametrize("scale", ["identity", "log", "logit", "axial"])
def test_what_moved_without_getting_narrower_is_told_as_it_is(scale):
    generator = np.random.default_rng(9)
    near, far = 0.2 * generator.normal(size=(2, 1000)) + np.array([[0.0], [0.6]])
    to_scale = {
        "identity": lambda x: x,
        "log": np.exp,
        "logit": lambda x: 1.0 / (1.0 + np.exp(-x)),
        # An axis across the cut at a right angle.
        "axial": lambda x: x + 0.5 * np.pi - 0.3,
    }[scale]
    prior, draws = to_scale(near), to_scale(far)
    ours = summarise(draws, equal(1000), prior, scale)
    assert ours["identified"] is False
    assert ours.is_prior == (False,)
    difference = ours["q50"] - np.median(draws)
    if scale == "axial":
        difference = math.remainder(difference, math.pi)
    assert abs(difference) < 1e-9
    unmoved = summarise(to_scale(near + 0.02), equal(1000), prior, scale)
    assert unmoved.is_prior == (True,)
    assert unmoved["mean"] == pytest.approx(prior.mean())


def test_few_draws_may_lie_apart_by_chance():
    prior = np.random.default_rng(10).normal(size=1000)
    ours = summarise(np.array([0.1, 2.0, 1.5, -0.5, 0.9, 2.2]), equal(6), prior)
    assert ours.is_prior == (True,)


def test_numbers_of_a_vector_that_moved_are_told_from_others():
    prior = np.random.default_rng(11).normal(size=(400, 2))
    ours = summarise(prior + np.array([2.0, 0.0]), equal(400), prior)
    assert ours["identified"] == [False, False]
    assert ours.is_prior == (False, True)
    assert ours["mean"] == pytest.approx(prior.mean(0) + np.array([2.0, 0.0]))


def test_headings_beside_the_cut_average_across_it():
    spread = 0.1 * np.random.default_rng(4).normal(size=500)
    angle = 0.5 * np.pi + spread
    flipped = np.where(np.arange(500) % 2 == 0, angle, angle - np.pi)
    prior = np.random.default_rng(5).uniform(-np.pi, np.pi, 500)
    ours = summarise(flipped, equal(500), prior, "axial")
    difference = math.remainder(ours["mean"] - angle.mean(), math.pi)
    assert abs(difference) < 1e-3
    assert ours["sd"] == pytest.approx(spread.std(), rel=1e-3)
    assert ours["identified"] is True
    assert ours["q05"] < ours["q50"] < ours["q95"]


def test_the_mean_direction_of_one_axis_is_that_axis():
    angle = np.array([0.3, 0.3 + np.pi, 0.3 - np.pi])
    assert axial_mean(angle, equal(3)) == pytest.approx(0.3, abs=1e-12)


def test_a_heading_that_was_not_learnt_has_the_priors_spread():
    angle = np.random.default_rng(6).uniform(-np.pi, np.pi, 4000)
    ours = summarise(angle, equal(4000), angle, "axial")
    assert ours["identified"] is False
    # A uniform angle modulo pi has this sd; 5 standard errors of it.
    assert ours["sd"] == pytest.approx(math.pi / math.sqrt(12), abs=5 * 0.008)


def test_a_number_that_was_given_counts_as_identified():
    ours = summarise(np.full(50, 20.0), equal(50), np.full(9, 20.0), "log")
    assert ours == {
        "mean": 20.0,
        "sd": 0.0,
        "q05": 20.0,
        "q50": 20.0,
        "q95": 20.0,
        "identified": True,
    }


def test_each_number_of_a_vector_is_judged_alone():
    prior = np.random.default_rng(7).normal(size=(400, 2))
    ours = summarise(prior * np.array([0.1, 1.0]), equal(400), prior)
    assert ours["identified"] == [True, False]
    assert ours["sd"] == pytest.approx(
        [0.1 * prior[:, 0].std(), prior[:, 1].std()], rel=1e-9
    )


def test_too_few_draws_identify_nothing():
    prior = np.random.default_rng(8).normal(size=400)
    weights = np.array([0.97, 0.01, 0.01, 0.01])
    ours = summarise(1e-3 * np.arange(4.0), weights, prior)
    assert ours["identified"] is False
    assert ours["mean"] == pytest.approx(prior.mean())


def test_infinite_limits_become_null():
    ours = summarise(np.full(20, np.inf), equal(20), np.full(20, np.inf), "log")
    assert ours["mean"] is None
    assert ours["q95"] is None
    mixed = np.where(np.arange(20) < 10, np.inf, 1.0)
    text = json.dumps(summarise(mixed, equal(20), mixed, "log"), allow_nan=False)
    assert json.loads(text)["mean"] is None


def test_plain_leaves_only_what_json_knows():
    value = {"a": np.float32("nan"), "b": [np.int64(3), np.array([1.0, np.inf])]}
    assert plain(value) == {"a": None, "b": [3, [1.0, None]]}


def test_a_single_hypothesis_says_what_it_is_and_counts_as_unidentified():
    prior = np.random.default_rng(0).normal(size=1000)
    found = summarise(np.array([2.5]), np.ones(1), prior)
    assert not found["identified"]
    assert [found[name] for name in ("mean", "q05", "q50", "q95")] == [2.5] * 4
    assert found["sd"] == 0.0
