"""Readings with Student-t noise, against its density, quadrature and particles."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

import boomdp_jax
from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.likelihoods.choice import choose_likelihood, outlier_remedy
from boomdp_jax.inference.likelihoods.filter_density import filter_density
from boomdp_jax.inference.likelihoods.kalman import NoiseLevel, extended_filter
from boomdp_jax.inference.likelihoods.robust_update import correct_robustly, scale_nodes
from boomdp_jax.inference.posteriors.random_motion import add_reading_noise
from boomdp_jax.inference.readings.outliers import isolated_readings, outlier_notes
from boomdp_jax.inference.readings.track_data import track_data
from boomdp_jax.physics import State
from tests.inference.recordings import DT, MASS, box_scene, free_box

FREEDOM = 4.0
GROSS = np.array([0.5, 0.5, 1.0, 2.0, 2.0, 4.0])


def level(num_bodies: int = 1) -> NoiseLevel:
    reading = jnp.tile(jnp.array([[1e-3, 1e-3, 5e-3, 5e-3]]), (num_bodies, 1))
    impulse = jnp.tile(jnp.array([[2e-3, 2e-3]]), (num_bodies, 1))
    return NoiseLevel(reading, impulse)


def spoilt(rng, history: History, share: float) -> History:
    """The same readings, some of them with gross errors."""
    reading = [np.asarray(history.state)[:1], np.asarray(history.next_state)]
    reading = np.concatenate(reading)
    is_bad = rng.random(reading.shape) < share
    reading = reading + is_bad * rng.normal(size=reading.shape) * GROSS
    return make_history(reading[:-1], np.asarray(history.action), reading[1:], DT)


def update(known: float, error: float, scale: float = 1.0):
    """Of one channel."""
    one = jnp.ones(1)
    return correct_robustly(
        known * jnp.ones((1, 1)), error * one, one, scale**2 * one, FREEDOM
    )


def test_nodes_make_a_student_t():
    """Out to a thousand scales; the sum over nodes errs by two in a thousand."""
    node, log_weight = scale_nodes(FREEDOM)
    errors = np.concatenate([[0.0], np.geomspace(0.1, 1e3, 40)])
    each = stats.norm.logpdf(errors[:, None], 0.0, 1.0 / np.sqrt(node)[None])
    found = np.logaddexp.reduce(each + log_weight[None], axis=1)
    np.testing.assert_allclose(found, stats.t(FREEDOM).logpdf(errors), atol=0.003)


@pytest.mark.parametrize("error", [0.0, 0.8, 3.0, 9.0])
def test_an_update_has_the_moments_of_the_exact_posterior(error):
    """By quadrature over the state, whose prior sd is 1.5 scales."""
    known, scale = 2.25, 0.7
    prior = stats.norm(0.0, 1.5)
    noise = stats.t(FREEDOM, scale=scale)

    def moment(power):
        def density(x):
            return x**power * prior.pdf(x) * noise.pdf(error - x)

        return integrate.quad(density, -12.0, 12.0, limit=400, points=[0.0, error])[0]

    total, first, second = (moment(power) for power in range(3))
    found = update(known, error, scale)
    np.testing.assert_allclose(found.log_density, np.log(total), atol=0.01)
    np.testing.assert_allclose(found.shift[0], first / total, atol=0.02)
    variance = second / total - (first / total) ** 2
    np.testing.assert_allclose(found.covariance[0, 0], variance, rtol=0.02)
    # The variance of normal noise with the same gain.
    gain = known / (known + found.variance[0])
    np.testing.assert_allclose(gain * error, found.shift[0], atol=1e-9)


def test_a_gross_error_leaves_the_state_as_it_was():
    found = update(1e-2, 500.0)
    assert abs(found.shift[0]) < 1e-3
    np.testing.assert_allclose(found.covariance[0, 0], 1e-2, rtol=1e-3)


def test_channels_that_were_not_read_change_nothing():
    covariance = jnp.array([[2.0, 0.5], [0.5, 1.0]])
    miss, variance = jnp.array([3.0, jnp.pi]), jnp.ones(2)
    found = correct_robustly(covariance, miss, jnp.zeros(2), variance, FREEDOM)
    np.testing.assert_array_equal(found.covariance, covariance)
    np.testing.assert_array_equal(found.shift, 0.0)
    assert float(found.log_density) == 0.0


def one_axis(history: History) -> History:
    """All but x and its rate as missing."""
    keep = np.array([1, np.nan, np.nan, 1, np.nan, np.nan])
    return make_history(
        np.asarray(history.state) * keep,
        np.asarray(history.action),
        np.asarray(history.next_state) * keep,
        DT,
    )


def particle_density(rng, history: History, mass: float, num: int = 20_000) -> float:
    """Marginal likelihood along x by particles that carry the noise's variances.

    Given those a Kalman filter is exact; they are drawn given each innovation and
    weighed by what the prior of theirs says.
    """
    scale, impulse = np.array([1e-3, 5e-3]), 2e-3
    matrix = np.array([[1.0, DT], [0.0, 1.0]])
    push = np.array([DT**2 / 2.0, DT]) / mass
    start = np.asarray(history.state)[0, 0, [0, 3]]
    mean = np.tile(start, (num, 1))
    covariance = np.tile(np.diag(2.0 * scale**2), (num, 1, 1))
    shaken = np.diag([0.0, impulse**2])
    log_total = 0.0
    for row in range(history.capacity):
        action = float(history.action[row, 0, 0])
        mean = mean @ matrix.T + push * action
        covariance = matrix @ (covariance + shaken) @ matrix.T
        log_weight = np.zeros(num)
        for channel, place in enumerate((0, 3)):
            reading = float(history.next_state[row, 0, place])
            error = reading - mean[:, channel]
            column, noise = covariance[:, :, channel], scale[channel] ** 2
            known = column[:, channel]
            rate = 0.5 * (FREEDOM + error**2 / (noise + known))
            proposal = stats.gamma(0.5 * (FREEDOM + 1.0), scale=1.0 / rate)
            weight = proposal.rvs(random_state=rng)
            spread = known + noise / weight
            log_weight += stats.norm.logpdf(error, 0.0, np.sqrt(spread))
            log_weight += stats.gamma(FREEDOM / 2.0, scale=2.0 / FREEDOM).logpdf(weight)
            log_weight -= proposal.logpdf(weight)
            gain = column / spread[:, None]
            mean = mean + gain * error[:, None]
            covariance = covariance - gain[:, :, None] * column[:, None]
        total = np.logaddexp.reduce(log_weight)
        log_total += total - np.log(num)
        share = np.exp(log_weight - total)
        place = (np.arange(num) + rng.random()) / num
        chosen = np.minimum(np.searchsorted(np.cumsum(share), place), num - 1)
        mean, covariance = mean[chosen], covariance[chosen]
    return log_total


@pytest.mark.slow
def test_the_marginal_likelihood_is_that_of_a_particle_filter():
    """Of a linear case with gross errors; also as a function of the mass."""
    rng = np.random.default_rng(0)
    history = one_axis(spoilt(rng, free_box(rng, 30), 0.1))
    data = track_data(history, (0,), True, freedom=FREEDOM)
    # The first reading is no outlier, so that both filters start with it.
    np.testing.assert_array_equal(data.first_mask[0, 0], [1, 0, 0, 1, 0, 0])
    found, expected = [], []
    for mass in (MASS, 1.01 * MASS):
        spec = box_scene(density=mass / 0.24)
        found.append(float(filter_density(spec.scene, spec.params(), data, level())))
        runs = [particle_density(rng, history, mass) for _ in range(3)]
        # Particles agree far better than what is asked for.
        assert np.ptp(runs) < 0.2
        expected.append(np.mean(runs))
    np.testing.assert_allclose(found, expected, atol=0.3)
    # Normal noise of the same scale would make gross errors next to impossible.
    plain = track_data(history, (0,), True)
    normal = float(filter_density(spec.scene, spec.params(), plain, level()))
    assert normal < found[1] - 1e3


@pytest.mark.slow
@pytest.mark.parametrize("is_chained", [True, False])
def test_both_filters_agree(is_chained):
    """One takes channels one by one, the other makes gains as well."""
    rng = np.random.default_rng(1)
    history = free_box(rng, 10, is_chained=is_chained)
    if is_chained:
        history = spoilt(rng, history, 0.1)
    spec = box_scene(density=MASS / 0.24)
    data = track_data(history, (0,), True, freedom=FREEDOM)
    found = extended_filter(spec.scene, spec.params(), data, level())
    expected = filter_density(spec.scene, spec.params(), data, level())
    np.testing.assert_allclose(found.log_likelihood, expected, rtol=1e-9)
    for leaf in jax.tree.leaves(found.gains):
        assert np.all(np.isfinite(leaf))


def test_spikes_are_found_and_impacts_are_not():
    """A hit changes a velocity for good, and a position bends."""
    rng = np.random.default_rng(2)
    history = free_box(rng, 60)
    reading = np.concatenate(
        [np.asarray(history.state)[:1], np.asarray(history.next_state)]
    )
    reading[30:, 0, 3] += 5.0
    reading[30:, 0, 0] += 5.0 * DT * np.arange(len(reading) - 30)
    planted = [(0, 1), (20, 2), (45, 0), (60, 4)]
    for row, channel in planted:
        reading[row, 0, channel] += 6.0
    whole = make_history(reading[:-1], np.asarray(history.action), reading[1:], DT)
    first, last = isolated_readings(whole)
    assert list(zip(*np.nonzero(first[:, 0]), strict=True)) == planted[:-1]
    expected = [(row - 1, channel) for row, channel in planted[1:]]
    assert list(zip(*np.nonzero(last[:, 0]), strict=True)) == expected


def test_normal_noise_gives_no_note_and_gross_errors_one():
    rng = np.random.default_rng(3)
    clean = free_box(rng, 100)
    assert outlier_notes(box_scene(), clean) == []
    (note,) = outlier_notes(box_scene(), spoilt(rng, clean, 0.05))
    assert note.startswith("box: ")
    assert "outliers='student-t'" in note
    nothing = np.zeros((0, 1, 6))
    empty = make_history(nothing, nothing[..., :3], nothing, DT)
    assert outlier_notes(box_scene(), empty) == []


@pytest.mark.parametrize(
    ("likelihood", "method"),
    [("filtered", "rj"), ("one-step", "rj"), ("open-loop", "map"), ("one-step", "svi")],
)
def test_what_a_note_advises_is_accepted(likelihood, method):
    """It names all that has to be another than it was."""
    advice = dict(re.findall(r"(\w+)='([^']+)'", outlier_remedy(likelihood, method)))
    assert advice["outliers"] == "student-t"
    options = {"likelihood": likelihood, "method": method, **advice}
    assert choose_likelihood(horizon=None, **options).name == "filtered"


@pytest.mark.parametrize("likelihood", ["one-step", "open-loop"])
def test_the_note_of_exact_starts_names_the_likelihood_too(likelihood):
    rng = np.random.default_rng(3)
    history = spoilt(rng, free_box(rng, 100), 0.05)
    found = boomdp_jax.infer(
        jax.random.key(0),
        box_scene(),
        history,
        method="map",
        likelihood=likelihood,
        num_samples=4,
    )
    (note,) = [each for each in found.diagnostics["notes"] if "lie far" in each]
    assert note.endswith("with such, outliers='student-t' with likelihood='filtered'")


def test_a_track_does_not_start_from_a_gross_error():
    rng = np.random.default_rng(4)
    history = free_box(rng, 20)
    state = np.asarray(history.state).copy()
    state[0, 0, 1] += 3.0
    worse = make_history(
        state, np.asarray(history.action), np.asarray(history.next_state), DT
    )
    data = track_data(worse, (0,), True, freedom=FREEDOM)
    assert data.first_mask[0, 0].tolist() == [1, 0, 1, 1, 1, 1]
    assert float(data.steps.mask[0].sum()) == 0.0
    plain = track_data(worse, (0,), True)
    assert float(plain.first_mask[0].sum()) == 6.0


@pytest.mark.slow
def test_noise_that_is_drawn_has_the_tails():
    """Share of draws beyond 4 scales; five standard errors of 60,000 draws."""
    state = State(jnp.zeros((10_000, 1, 3)), jnp.zeros((10_000, 1, 3)))
    scale = jnp.array([[1.0, 2.0, 3.0, 4.0]])
    draws = add_reading_noise(
        jax.random.key(0), state, scale, jnp.zeros(1, bool), FREEDOM
    ).array
    units = np.asarray(draws)[:, 0] / [1.0, 1.0, 2.0, 3.0, 3.0, 4.0]
    share = 2.0 * stats.t(FREEDOM).sf(4.0)
    error = np.sqrt(share * (1.0 - share) / units.size)
    assert np.mean(np.abs(units) > 4.0) == pytest.approx(share, abs=5.0 * error)


def test_settings_that_make_no_sense_are_refused():
    history = free_box(np.random.default_rng(5), 3)
    with pytest.raises(ValueError, match="outliers: expected one of none, student-t"):
        boomdp_jax.infer(jax.random.key(0), box_scene(), history, outliers="huber")
    with pytest.raises(ValueError, match="outliers: expected none with method 'nuts'"):
        boomdp_jax.infer(
            jax.random.key(0),
            box_scene(),
            history,
            outliers="student-t",
            method="nuts",
        )


@pytest.mark.slow
def test_masses_stay_right_with_gross_errors_and_the_default_says_so():
    """Errors over sds of twenty masses; bound of a chi-square, one in a thousand.

    There is no lower bound: where the motion has no noise of its own, not knowing so
    makes intervals a little wide, with normal readings just as well.
    """
    with jax.enable_x64(False):
        rng = np.random.default_rng(6)
        clean = [free_box(rng, 60) for _ in range(20)]
        histories = [spoilt(rng, history, 0.05) for history in clean]
        counts = {"num_samples": 100, "num_warmup": 50}
        robust, plain = (
            boomdp_jax.infer_batch(
                jax.random.key(0),
                [box_scene()] * num,
                histories[:num],
                outliers=outliers,
                **counts,
            )
            for outliers, num in (("student-t", 20), ("none", 6))
        )
    masses = [p.to_json()["bodies"]["box"]["mass"] for p in robust]
    squares = [((mass["mean"] - MASS) / mass["sd"]) ** 2 for mass in masses]
    assert np.sum(squares) < stats.chi2(len(squares)).ppf(1.0 - 1e-3)
    spread = np.median([mass["sd"] for mass in masses])
    # Gross errors of half a metre in one reading of twenty, against a millimetre.
    wide = [p.to_json()["bodies"]["box"]["mass"]["sd"] for p in plain]
    assert np.median(wide) > 10.0 * spread
    for posterior in plain:
        assert "student-t" in "; ".join(posterior.diagnostics["notes"])
        assert "student-t" in posterior.summary()
    assert all(p.degrees_of_freedom == FREEDOM for p in robust)
    assert all(p.degrees_of_freedom is None for p in plain)
