"""One coordinate over the objects of a kind: densities against SciPy and quadrature."""

import numpy as np
import pytest
from scipy import special, stats

from boomdp_jax.inference.kinds.coordinates import CoordinateModel, log_bessel, wrap
from boomdp_jax.inference.kinds.prior import KindPrior, check_kind_prior
from tests.inference.kind_problems import log_group, plain_model
from tests.inference.linear_gaussian import two_sided

PERIOD = np.pi


def heading_model() -> CoordinateModel:
    """A plain coordinate and a heading; the last spread is not shared."""
    return CoordinateModel(
        period=np.array([0.0, PERIOD]),
        spread=np.array([[0.1, 0.4, 1.0], [0.1, 0.4, np.inf]]),
        log_weight=np.log(np.tile([0.5, 0.3, 0.2], (2, 1))),
    )


def sums(model: CoordinateModel, values: np.ndarray) -> tuple[np.ndarray, ...]:
    """What `values [object, coordinate]` add up to."""
    first, second = model.moments(values)
    num = np.full(values.shape[1], float(len(values)))
    return num, first.sum(0), second.sum(0)


def test_the_bessel_function_agrees_with_scipy():
    x = np.concatenate([[0.0], np.geomspace(1e-3, 1e5, 400)])
    expected = np.log(special.i0e(x)) + x
    np.testing.assert_allclose(log_bessel(x), expected, atol=2e-8, rtol=1e-10)


def test_one_object_has_the_ordinary_prior_whatever_the_spread():
    model = heading_model()
    values = np.array([[0.7, -1.1]])
    found = model.log_marginal(*sums(model, values))
    np.testing.assert_allclose(found[0], stats.norm.logpdf(0.7), rtol=1e-12)
    np.testing.assert_allclose(found[1], -np.log(PERIOD), rtol=1e-7)


def test_the_marginal_of_several_is_a_correlated_normal():
    values = np.random.default_rng(0).normal(size=(4, 1)) * 0.3 + 0.5
    model = plain_model(1)
    each = model.log_marginal(*sums(model, values))[0] + model.log_weight[0]
    found = np.logaddexp.reduce(each)
    assert found == pytest.approx(log_group(values[:, 0], 0.0), rel=1e-10)


def test_the_marginal_of_headings_is_an_average_over_the_kinds_heading():
    values = np.array([1.5, -1.55, 1.2])
    model = heading_model()
    table = np.column_stack([np.zeros(3), values])
    found = model.log_marginal(*sums(model, table))[1]
    centre = (np.arange(20_000) + 0.5) / 20_000 * PERIOD
    for spread, value in zip(model.spread[1, :2], found, strict=False):
        kappa = (2 * np.pi / PERIOD * spread) ** -2
        density = np.ones_like(centre)
        for each in values:
            turn = 2 * np.pi / PERIOD * (each - centre)
            density *= stats.vonmises.pdf(turn, kappa) * 2 * np.pi / PERIOD
        assert value == pytest.approx(np.log(density.mean()), abs=1e-7)
    assert found[2] == pytest.approx(-3 * np.log(PERIOD))


def test_predictions_multiply_to_the_marginal():
    rng = np.random.default_rng(1)
    model = heading_model()
    values = wrap(rng.normal(size=(5, 2)) * 0.4 + 1.4, model.period)
    for index in np.ndindex(3, 3):
        chosen = np.array(index)
        total = np.zeros(2)
        for n in range(5):
            before = sums(model, values[:n])
            total += model.log_predictive(values[n], *before, chosen)
        marginal = model.log_marginal(*sums(model, values))[np.arange(2), chosen]
        np.testing.assert_allclose(total, marginal, rtol=1e-6, atol=1e-7)


def test_draws_follow_the_prediction():
    rng = np.random.default_rng(2)
    model, num = heading_model(), 20_000
    values = np.array([[0.5, 1.5], [0.7, -1.5]])
    before = [np.tile(x, (num, 1)) for x in sums(model, values)]
    index = np.ones((num, 2), int)
    drawn = model.draw_predictive(rng, *before, index)
    mean, variance = (x[0, 0] for x in model.predictive(*before, index))
    assert stats.kstest(drawn[:, 0], stats.norm(mean, variance**0.5).cdf).pvalue > 1e-4
    # The distribution function of the heading by quadrature of its density.
    grid = (np.arange(4000) + 0.5) / 4000 * PERIOD - PERIOD / 2
    table = np.column_stack([np.zeros(4000), grid])
    around = [np.tile(x, (4000, 1)) for x in sums(model, values)]
    density = np.exp(model.log_predictive(table, *around, index[:4000])[:, 1])
    assert density.mean() * PERIOD == pytest.approx(1.0, abs=1e-6)
    level = np.interp(drawn[:, 1], grid, np.cumsum(density) * PERIOD / 4000)
    assert stats.kstest(level, "uniform").pvalue > 1e-4


def test_a_kinds_own_mean_and_its_objects_agree():
    """p(z | mu) averaged over draws of mu is the prediction."""
    rng = np.random.default_rng(3)
    model, num = heading_model(), 40_000
    values = np.array([[0.5, 1.5], [0.7, -1.5]])
    before = [np.tile(x, (num, 1)) for x in sums(model, values)]
    index = np.ones((num, 2), int)
    centre = model.draw_centre(rng, *before, index)
    point = np.tile([0.4, 1.3], (num, 1))
    density = np.exp(model.log_given_centre(point, centre, index))
    expected = np.exp(model.log_predictive(point, *before, index)[0])
    error = density.std(0) / np.sqrt(num)
    assert np.all(np.abs(density.mean(0) - expected) < two_sided(1e-4, 2) * error)


def test_spreads_follow_their_prior():
    model, num = heading_model(), 30_000
    drawn = model.draw_spread(np.random.default_rng(4), (num,))
    for column in range(2):
        share = np.bincount(drawn[:, column], minlength=3) / num
        error = np.sqrt(0.25 / num)
        assert np.max(np.abs(share - [0.5, 0.3, 0.2])) < two_sided(1e-4, 6) * error


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"spreads": (0.1, 2.0), "weights": (1.0, 1.0)}, "spreads: expected numbers"),
        ({"weights": (1.0,)}, "weights: expected 4 positive weights"),
        ({"structure_weight": 0.0}, "structure_weight: expected a positive number"),
    ],
)
def test_a_prior_that_makes_no_sense_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        check_kind_prior(KindPrior(**fields))
