"""What noises leave open by one linearised track, against a filter for each of them."""

import jax
import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.inference.blocks.block import stack_blocks
from boomdp_jax.inference.fits.find_modes import find_single_step_modes
from boomdp_jax.inference.fits.fit import (
    Fits,
    FitSettings,
    Host,
    climb,
    normal_equations,
)
from boomdp_jax.inference.fits.fit_noise import with_gains
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit
from boomdp_jax.inference.likelihoods.filter_points import filter_points
from boomdp_jax.inference.noise.levels import _parts
from boomdp_jax.inference.noise.volume import OpenVolumes, open_volumes, sound
from boomdp_jax.inference.online.fit import make_online_block, refit_settings
from tests.inference.online_worlds import DT, NOISE, box_world, simulate

NUM_ROWS, NUM_NOISES = 32, 12
PINNED = 1


def recorded():
    """A pinned box: two episodes, gaps, and instants that are read twice."""
    rows = simulate(2, ["pinned"] * NUM_ROWS)
    rng = np.random.default_rng(0)
    state, next_state = rows.state[:, None].copy(), rows.next_state[:, None].copy()
    again = np.arange(NUM_ROWS) % 5 == 3
    state[again] += NOISE * rng.normal(size=(again.sum(), 1, 6))
    for readings in (state, next_state):
        readings[rng.random(readings.shape) < 0.1] = np.nan
    episode = (np.arange(NUM_ROWS) >= 20).astype(int)
    return make_history(state, rows.action[:, None], next_state, DT, episode=episode)


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(1.0, id="all alike"),
        pytest.param(0.97, id="forgetting", marks=pytest.mark.slow),
    ],
)
def problem(request):
    """Targets, a hypothesis near the best fit, its track, and noises about that's."""
    settings = refit_settings(
        box_world([], is_hidden=True, unknown={"revolute": 1}),
        num_particles=16,
        is_uniform=True,
        forgetting=request.param,
        change_rate=0.0,
        num_levels=1,
    )
    targets = stack_blocks([make_online_block(settings, (0,), recorded())])
    modes = find_single_step_modes(jax.random.key(0), targets, FitSettings(num_modes=1))
    assert np.asarray(targets.structures)[0, PINNED].any()
    z = np.asarray(modes.z, float)[0, PINNED]
    reading = NOISE[None, None, [0, 2, 3, 5]]
    middle = NoiseFit(reading, 0.3 * reading[..., 2:])
    fits = Fits(
        np.zeros(1, int),
        np.full(1, PINNED),
        z[None],
        np.zeros(1),
        np.asarray(modes.precision, float)[0, [PINNED]],
    )
    targets = with_gains(targets, fits, middle)
    fits = climb(targets, fits, 8)
    _, precision = normal_equations(targets, Host.of(targets), fits)
    # Elsewhere than at the best fit, for gradients that are not nothing.
    moved = np.where(Host.of(targets).in_use[PINNED], 1.0, 0.0)
    moved *= 0.5 / np.sqrt(np.diagonal(precision[0]))
    fits = fits._replace(z=fits.z + moved, precision=precision)
    filtered = filter_points(targets, fits.index, fits.structure, fits.z, middle)
    rng = np.random.default_rng(1)
    spread = np.array([0.2, 0.2, 0.2, 0.2, 1.0, 1.0])
    vector = middle.vector + spread * rng.normal(size=(NUM_NOISES, 6))
    return targets, fits, (middle, filtered), NoiseFit.of_vector(vector)


@pytest.mark.slow
def test_volumes_are_those_of_a_filter_for_each_noise(problem):
    targets, fits, track, noise = problem
    champion, precision = fits.z[0], fits.precision[0]
    found = open_volumes(targets, PINNED, champion, precision, track, noise)
    in_use = Host.of(targets).in_use[PINNED]
    volume, variance = np.empty(NUM_NOISES), np.empty((NUM_NOISES, len(champion)))
    for k in range(NUM_NOISES):
        own = with_gains(targets, fits, noise.take(np.array([k])))
        ((gradient,), (matrix,)) = normal_equations(own, Host.of(own), fits)
        inverse = np.linalg.inv(matrix)
        gain = 0.5 * gradient @ inverse @ gradient
        volume[k] = gain - 0.5 * np.linalg.slogdet(matrix)[1]
        variance[k] = np.diagonal(inverse)
    # They have to differ for their likeness to say anything.
    assert np.ptp(volume) > 1.0
    assert np.std(found.log_volume - volume) < 0.1 * np.std(volume)
    assert abs(np.mean(found.log_volume - volume)) < 0.1
    ratio = (found.variance / variance)[:, in_use]
    assert np.ptp(np.log(variance)[:, in_use], axis=0).max() > 0.5
    np.testing.assert_allclose(ratio, 1.0, atol=0.1)
    np.testing.assert_allclose(found.variance[:, ~in_use], 1.0)


@pytest.mark.parametrize("shift", [300.0, -6.0, -9.0, -12.0, -300.0])
def test_noises_far_off_harm_no_others(problem, shift):
    targets, fits, track, noise = problem
    vector = noise.vector.copy()
    vector[0] += shift
    known = (targets, PINNED, fits.z[0], fits.precision[0], track)
    near = open_volumes(*known, noise)
    found = open_volumes(*known, NoiseFit.of_vector(vector))
    assert np.isfinite(found.log_volume).all()
    assert np.isfinite(found.variance).all()
    assert (found.variance > 0.0).all()
    np.testing.assert_allclose(found.log_volume[1:], near.log_volume[1:])
    np.testing.assert_allclose(found.variance[1:], near.variance[1:])


def test_expansions_that_rounding_has_spoilt_are_told_from_others():
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(4, 4)))[0]

    def of_curvatures(*values):
        scale = np.diag([1.0, 1e6, 1e-6, 1.0])
        return scale @ turn @ np.diag(values) @ turn.T @ scale

    good = of_curvatures(1.0, 1e-6, 1e6, 3.0)
    spoilt = of_curvatures(1.0, -1e-6, 1e6, 3.0)
    matrix = np.stack([good, spoilt, good, np.full((4, 4), np.nan)])
    gradient = np.ones((4, 4))
    gradient[2, 1] = np.inf
    assert sound(gradient, matrix).tolist() == [True, False, False, False]


def test_parts_have_all_the_mass_in_order_of_what_is_open():
    rng = np.random.default_rng(3)
    log_volume = 0.5 * rng.normal(size=200)
    variance = np.exp(2.0 * log_volume[:, None] + 0.01 * rng.normal(size=(200, 3)))
    log_mass = rng.normal(size=200) - 1000.0
    rows, log_share = _parts(log_mass, OpenVolumes(log_volume, variance), 8)
    assert np.all(np.diff(log_volume[rows]) > 0.0)
    total = np.logaddexp.reduce(log_mass)
    assert np.logaddexp.reduce(log_share) == pytest.approx(total)
    # Few levels come to the variances of all noises.
    share, mass = np.exp(log_share - total), np.exp(log_mass - total)
    np.testing.assert_allclose(share @ variance[rows], mass @ variance, rtol=0.1)


def test_a_noise_that_has_nearly_all_the_mass_stands_for_several_parts():
    log_mass = np.array([-50.0, 0.0, -9.0, -1e30])
    log_volume = np.array([0.0, 1.0, 2.0, -1e30])
    variance = np.exp(log_volume)[:, None] + 1.0
    rows, log_share = _parts(log_mass, OpenVolumes(log_volume, variance), 4)
    np.testing.assert_array_equal(rows, 1)
    np.testing.assert_allclose(np.exp(log_share).sum(), 1.0 + np.exp(-9.0))
