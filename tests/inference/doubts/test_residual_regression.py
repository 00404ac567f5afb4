"""Evidence for a further law against Gaussian integrals, and whiteness by its rates."""

import numpy as np
import pytest
from scipy import stats

from boomdp_jax.inference.doubts.residual_laws import LAWS, Path
from boomdp_jax.inference.doubts.residual_regression import (
    _chi_square_tail,
    absorb,
    fit_law,
    whiteness,
)


def problem(rng, num_rows: int = 40, num_parts: int = 1, size: float = 0.0, noise=1.0):
    """Innovations of two channels with three coordinates and a law; no prior binds."""
    jacobian = rng.normal(size=(3, num_rows, 2))
    law = rng.normal(size=(num_parts, num_rows, 2)) + 0.5 * jacobian[:1]
    moves, coefficient = rng.normal(size=3), size * np.ones(num_parts)
    innovation = noise * rng.normal(size=(num_rows, 2))
    innovation -= np.einsum("dtc,d->tc", jacobian, moves)
    innovation -= np.einsum("dtc,d->tc", law, coefficient)
    return innovation, jacobian, law


@pytest.mark.parametrize("num_parts", [1, 2])
def test_the_bayes_factor_is_a_ratio_of_gaussian_integrals(num_parts):
    """With less noise than unit the jackknife does not bind, and evidence is exact."""
    rng = np.random.default_rng(0)
    innovation, jacobian, law = problem(rng, num_parts=num_parts, size=0.3, noise=0.3)
    z = rng.normal(size=3)
    found = fit_law(absorb(innovation, jacobian, z, np.ones(3, bool)), law)
    assert found is not None
    columns, further = jacobian.reshape(3, -1).T, law.reshape(num_parts, -1).T
    # z + dz is standard normal: -J dz has mean J z and covariance J J^T.
    mean = columns @ z
    covariance = np.eye(len(mean)) + columns @ columns.T
    precision = np.linalg.inv(covariance)
    prior = len(innovation) * np.linalg.inv(further.T @ precision @ further)
    with_law = covariance + further @ prior @ further.T
    target = innovation.reshape(-1)
    expected = stats.multivariate_normal(mean, with_law).logpdf(target)
    expected -= stats.multivariate_normal(mean, covariance).logpdf(target)
    np.testing.assert_allclose(found.log_bayes_factor, expected, rtol=1e-8)
    sd = np.sqrt(np.diagonal(np.linalg.inv(further.T @ precision @ further)))
    np.testing.assert_allclose(found.sd, sd, rtol=1e-8)
    assert np.all(np.abs(found.coefficient - 0.3) < 4.0 * 0.3 * sd)


def test_evidence_without_a_law_exceeds_a_level_as_rarely_as_stated():
    """Markov's bound e^-T, by far: 2,000 cases, five standard errors at T = 2."""
    rng = np.random.default_rng(1)
    num = 2000
    found = np.empty(num)
    for i in range(num):
        innovation, jacobian, law = problem(rng, num_rows=15)
        fit = fit_law(absorb(innovation, jacobian, np.zeros(3), np.zeros(3, bool)), law)
        assert fit is not None
        found[i] = fit.log_bayes_factor
    bound = np.exp(-2.0)
    assert np.mean(found > 2.0) < bound + 5.0 * np.sqrt(bound / num)
    # Kass and Raftery's "positive" evidence must occur, or nothing would ever be found.
    assert np.any(found > 1.0)


def test_a_few_kicks_are_no_law():
    """However large, and though they lie along it; the same all along are one."""
    rng = np.random.default_rng(2)
    innovation, jacobian, law = problem(rng)
    kicked = innovation.copy()
    kicked[[7, 23]] += 50.0 * law[0, [7, 23]]
    is_normal = np.zeros(3, bool)
    fit = fit_law(absorb(kicked, jacobian, np.zeros(3), is_normal), law)
    assert fit is not None
    assert fit.log_bayes_factor < 3.0
    all_along = innovation + 2.0 * law[0]
    fit = fit_law(absorb(all_along, jacobian, np.zeros(3), is_normal), law)
    assert fit is not None
    assert fit.log_bayes_factor > 20.0
    np.testing.assert_allclose(fit.coefficient, -2.0, atol=5.0 * fit.sd[0])


def test_what_a_number_of_the_model_absorbs_is_no_law():
    rng = np.random.default_rng(3)
    innovation, jacobian, _ = problem(rng)
    known = absorb(
        innovation + 5.0 * jacobian[0], jacobian, np.zeros(3), np.zeros(3) > 0
    )
    assert fit_law(known, 2.0 * jacobian[:1]) is None
    assert fit_law(known, np.zeros_like(jacobian[:1])) is None
    # Where the prior holds the number, evidence is what the prior allows.
    held = absorb(innovation + 5.0 * jacobian[0], jacobian, np.zeros(3), np.ones(3) > 0)
    fit = fit_law(held, jacobian[:1])
    assert fit is not None
    free = fit_law(
        absorb(
            innovation + 5.0 * jacobian[0], jacobian[1:], np.zeros(2), np.zeros(2) > 0
        ),
        jacobian[:1],
    )
    assert free is not None
    assert fit.log_bayes_factor < 0.5 * 5.0**2 < free.log_bayes_factor


@pytest.mark.parametrize("num", [1, 2, 3, 4])
def test_the_chi_square_tail_is_scipys(num):
    for value in (0.01, 1.0, 7.0, 60.0):
        expected = stats.chi2(num).sf(value)
        np.testing.assert_allclose(_chi_square_tail(value, num), expected, rtol=1e-10)


@pytest.mark.parametrize("freedom", [np.inf, 4.0])
def test_white_innovations_pass_at_the_stated_rate(freedom):
    """Normal and heavy-tailed ones, 100 rows, 2,000 cases; five standard errors."""
    rng = np.random.default_rng(4)
    num, level = 2000, 0.01
    track = np.arange(100) // 25
    values = rng.normal(size=(num, 100, 2))
    if np.isfinite(freedom):
        values /= np.sqrt(rng.chisquare(freedom, size=(num, 100, 1)) / freedom)
    counts = np.ones((100, 2))
    counts[3:9] = 0.0
    found = [whiteness(value, counts, track) for value in values]
    assert all(p is not None for p in found)
    rate = np.mean(np.array(found, float) < level)
    assert rate < level + 5.0 * np.sqrt(level / num)


def test_correlated_innovations_do_not_pass_and_few_are_not_judged():
    rng = np.random.default_rng(5)
    value = np.zeros((100, 1))
    for row in range(1, 100):
        value[row] = 0.7 * value[row - 1] + rng.normal()
    track = np.zeros(100, int)
    p_value = whiteness(value, np.ones((100, 1)), track)
    assert p_value is not None
    assert p_value < 1e-4
    # Every row a track of its own: nothing to compare.
    assert whiteness(value, np.ones((100, 1)), np.arange(100)) is None
    assert whiteness(value[:10], np.ones((10, 1)), track[:10]) is None


def random_path(rng) -> Path:
    shape = (30, 3)
    progress = (np.arange(30) + 0.5) / 30 - 0.5
    row = np.arange(30) % 10
    rest = np.full((30, 2), 1e-3), progress, row, 9 - row
    return Path(*rng.normal(size=(5, *shape)), *rest)


def test_laws_of_the_bodys_own_frame_turn_with_the_world():
    """All but a constant push and what depends on the heading itself."""
    rng = np.random.default_rng(6)
    path, angle = random_path(rng), 0.7
    turn = np.eye(3)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    turned = Path(
        path.pose @ turn.T + np.array([0.0, 0.0, angle]),
        path.twist @ turn.T,
        path.wrench @ turn.T,
        path.change @ turn.T,
        path.change_ahead @ turn.T,
        path.spread,
        path.progress,
        path.since_begin,
        path.until_end,
    )
    for law in LAWS:
        # Mirrors, and components along a body's axes, are no turns of the world.
        if law.name in ("x_negated", "y_negated", "exchanged", "own_frame"):
            continue
        if law.name in ("constant_force", "heading", "axis_limit"):
            continue
        for first, second in zip(law.wrench(path), law.wrench(turned), strict=True):
            np.testing.assert_allclose(first @ turn.T, second, atol=1e-12)


def test_friction_like_laws_give_power_and_levers_give_the_torque():
    """With a positive coefficient, hence a loss with a negative one."""
    rng = np.random.default_rng(7)
    path = random_path(rng)
    for law in LAWS:
        if "viscous" in law.name or "coulomb" in law.name or "drag" in law.name:
            (wrench,) = law.wrench(path)
            assert np.all(np.sum(wrench * path.twist, axis=1) >= 0)
    (lever,) = [law for law in LAWS if law.name == "lever"]
    cos, sin = np.cos(path.pose[:, 2]), np.sin(path.pose[:, 2])
    place = np.array([0.2, -0.1])
    arm = np.column_stack(
        [cos * place[0] - sin * place[1], sin * place[0] + cos * place[1]]
    )
    expected = arm[:, 0] * path.wrench[:, 1] - arm[:, 1] * path.wrench[:, 0]
    found = sum(c * w[:, 2] for c, w in zip(place, lever.wrench(path), strict=True))
    np.testing.assert_allclose(found, expected, atol=1e-12)
