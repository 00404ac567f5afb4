"""Evaluation in chunks, fits and noise, against plain calls, SciPy and closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from boomdp_jax.core.history import make_history
from boomdp_jax.inference.blocks.block import make_block, stack_blocks
from boomdp_jax.inference.fits.find_modes import find_modes
from boomdp_jax.inference.fits.fit import (
    Fits,
    FitSettings,
    Host,
    best_of_each,
    climb,
    make_fits,
    normal_equations,
)
from boomdp_jax.inference.fits.fit_groups import FitGroups
from boomdp_jax.inference.fits.fit_noise import fit_noise, with_gains
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit
from boomdp_jax.inference.likelihoods.evaluate import evaluate_points
from boomdp_jax.inference.likelihoods.one_step import OneStepLikelihood
from boomdp_jax.physics import scene_spec_from_dict
from tests.inference.recordings import AREA, MASS, NOISE, box_scene, free_box

WHEELED = {"wheel": 1}


@pytest.fixture(scope="module")
def wheeled():
    """Two boxes that may have a wheel, with one-step gains."""
    spec = box_scene(WHEELED)
    return stack_blocks(
        [
            make_block(spec, (0,), free_box(np.random.default_rng(seed), 8))
            for seed in (0, 1)
        ]
    )


def random_points(targets, num):
    rng = np.random.default_rng(7)
    num_structures = targets.structures.shape[1]
    index = rng.integers(0, targets.structures.shape[0], num)
    structure = rng.integers(0, num_structures, num)
    z = rng.normal(size=(num, targets.slot.shape[1]))
    z = np.where(Host.of(targets).in_use[structure], z, 0.0)
    return index, structure, z


@pytest.mark.slow
def test_points_in_any_order_are_evaluated_as_alone(wheeled):
    index, structure, z = random_points(wheeled, 70)
    found = evaluate_points(wheeled, index, structure, z)

    @jax.jit
    def alone(i, k, z):
        target = jax.tree.map(lambda leaf: leaf[i], wheeled)
        return target.log_density(k, z)

    expected = [alone(i, k, p) for i, k, p in zip(index, structure, z, strict=True)]
    np.testing.assert_allclose(found.log_density, expected, rtol=1e-9)


@pytest.mark.slow
def test_points_of_a_pair_are_evaluated_as_alone():
    """Their chunks have points of several structures, and of gains of their own."""
    rng = np.random.default_rng(3)
    half = {"type": "box", "half_extents": [0.2, 0.1]}
    spec = scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": 0.02,
            "bodies": [
                {"name": "left", "shape": half, "pose": [0.0, 0.0, 0.0]},
                {"name": "right", "shape": half, "pose": [0.5, 0.0, 0.0]},
            ],
            "unknown": {"revolute": 1},
        }
    )
    state = 0.05 * rng.normal(size=(7, 2, 6)) + [0.0] * 6
    state[:, 1, 0] += 0.5
    wrench = rng.normal(size=(6, 2, 3))
    history = make_history(state[:-1], wrench, state[1:], 0.02)
    targets = stack_blocks([make_block(spec, (0, 1), history)])
    num_structures = targets.structures.shape[1]
    assert num_structures > 3
    gains = jax.tree.map(
        lambda leaf: leaf * (1.0 + 0.3 * rng.random(leaf.shape)),
        targets.log_likelihood.gains,
    )
    targets = eqx.tree_at(lambda t: t.log_likelihood.gains, targets, gains)
    index, structure, z = random_points(targets, 90)
    found = evaluate_points(targets, index, structure, 0.3 * z)

    @jax.jit
    def alone(k, z):
        target = jax.tree.map(lambda leaf: leaf[0], targets)
        return target.log_density(k, z)

    expected = [alone(k, 0.3 * p) for k, p in zip(structure, z, strict=True)]
    np.testing.assert_allclose(found.log_density, expected, rtol=1e-9)


@pytest.mark.slow
def test_one_step_gains_give_the_one_step_likelihood(wheeled):
    index, structure, z = random_points(wheeled, 6)
    found = evaluate_points(wheeled, index, structure, z)

    @jax.jit
    def one_step(i, k, z):
        target = jax.tree.map(lambda leaf: leaf[i], wheeled)
        tracked = target.log_likelihood
        plain = OneStepLikelihood(tracked.coordinates, tracked.data.steps)
        active = target.structures[k]
        return target.log_prior_density(k, z) + plain(z, active)

    expected = [one_step(i, k, p) for i, k, p in zip(index, structure, z, strict=True)]
    np.testing.assert_allclose(found.log_density, expected, rtol=1e-9)


@pytest.mark.slow
def test_gradient_is_that_of_the_log_density(wheeled):
    index, structure, z = random_points(wheeled, 6)
    fits = make_fits(wheeled, index, structure, 0.5 * z)
    gradient, _ = normal_equations(wheeled, Host.of(wheeled), fits)
    step = 1e-5
    for coordinate in range(z.shape[1]):
        shift = step * np.eye(z.shape[1])[coordinate]
        up = evaluate_points(wheeled, index, structure, fits.z + shift).log_density
        down = evaluate_points(wheeled, index, structure, fits.z - shift).log_density
        slope = -(up - down) / (2.0 * step)
        in_use = Host.of(wheeled).in_use[structure, coordinate]
        expected = np.where(in_use, slope, 0.0)
        # A heading's prior is flat; the differences behind the gradient are one-sided.
        scale = 1.0 + np.abs(gradient).max(axis=1)
        assert np.all(np.abs(gradient[:, coordinate] - expected) < 0.02 * scale)


@pytest.fixture(scope="module")
def box():
    """Two free boxes with nothing else to know than their mass."""
    spec = box_scene()
    rng = np.random.default_rng(5)
    return stack_blocks([make_block(spec, (0,), free_box(rng, 60)) for _ in range(2)])


@pytest.mark.slow
def test_a_heading_that_changes_nothing_is_as_wide_as_half_a_turn(wheeled):
    structures = np.asarray(wheeled.structures[0])
    wheel = np.flatnonzero(structures.any(axis=1))[:1]
    host = Host.of(wheeled)
    heading = host.period > 0
    # With such a limit to its friction a wheel has none.
    z = np.where(host.in_use[wheel] & ~heading, -60.0, 0.0)
    z[:, 0] = 0.0
    fits = make_fits(wheeled, np.zeros(1, int), wheel, z)
    _, matrix = normal_equations(wheeled, host, fits)
    assert heading.sum() == 1
    np.testing.assert_allclose(matrix[0, heading, heading], 12.0 / np.pi**2, rtol=1e-3)
    assert np.linalg.eigvalsh(matrix[0])[0] > 0.9


@pytest.mark.slow
def test_a_structure_that_lacks_too_much_stays_where_it_is(wheeled):
    index, structure, z = random_points(wheeled, 40)
    index, z = 0 * index, 0.5 * z
    fits = make_fits(wheeled, index, structure, z)
    best = [fits.value[structure == k].max() for k in range(2)]
    gap = abs(best[1] - best[0])
    worse = int(np.argmin(best))
    both = climb(wheeled, fits, 2, np.array([gap + 1.0, 0.0]))
    for k in range(2):
        assert np.all(both.value[structure == k] >= fits.value[structure == k])
        assert both.value[structure == k].max() > best[k] + 1.0
    one = climb(wheeled, fits, 2, np.array([gap - 1e-3, 0.0]))
    left = structure == worse
    np.testing.assert_array_equal(one.z[left], fits.z[left])
    np.testing.assert_array_equal(one.z[~left], both.z[~left])


def test_fits_are_worth_going_on_with_by_their_structure_and_object():
    index = np.array([0, 0, 0, 1, 1])
    structure = np.array([0, 0, 1, 0, 1])
    value = np.array([-9.0, -1.0, 0.0, -50.0, -60.0])
    groups = FitGroups(index, structure, 2, 2)
    np.testing.assert_array_equal(groups.best(value), [-1.0, -1.0, 0.0, -50.0, -60.0])
    found = groups.is_worth(value, np.array([0.5, 20.0]))
    np.testing.assert_array_equal(found, [False, False, True, True, True])
    found = groups.is_worth(value, np.array([2.0, 5.0]))
    np.testing.assert_array_equal(found, [True, True, True, True, False])


def test_fits_lead_to_the_same_place_within_a_third_of_a_standard_deviation():
    turn = np.array([0.0, 2.0])
    groups = FitGroups(np.zeros(5, int), np.array([0, 0, 0, 0, 1]), 1, 2)
    z = np.array([[0.0, 0.99], [0.02, -0.99], [0.02, 0.6], [0.2, 0.99], [0.0, 0.99]])
    precision = np.tile(np.diag([100.0, 1.0]), (5, 1, 1))

    def wrap(z):
        return np.where(turn > 0, z - turn * np.round(z / np.maximum(turn, 1e-9)), z)

    found = groups.is_repeated(np.array([5.0, 4, 3, 2, 1]), z, precision, wrap)
    np.testing.assert_array_equal(found, [False, True, False, False, False])


@pytest.mark.slow
def test_climb_reaches_the_maximum_that_scipy_finds(box):
    start = make_fits(box, np.arange(2), np.zeros(2, int), np.array([[1.5], [-1.0]]))
    found = climb(box, start, 12)

    for i in range(2):

        def height(z, i=i):
            point = np.array([[z]])
            return -evaluate_points(
                box, np.array([i]), np.zeros(1, int), point
            ).log_density[0]

        best = minimize_scalar(
            height, bracket=(found.z[i, 0] - 0.1, found.z[i, 0] + 0.1)
        )
        np.testing.assert_allclose(found.z[i, 0], best.x, atol=2e-4)
        assert found.value[i] >= -best.fun - 1e-2


@pytest.mark.slow
def test_noise_is_found(box):
    truth = np.log(MASS / AREA / 30.0) / 1.5
    best = make_fits(box, np.arange(2), np.zeros(2, int), np.full((2, 1), truth))
    start = NoiseFit(np.full((2, 1, 4), 1e-2), np.full((2, 1, 2), 4e-3))
    noise = fit_noise(box, best, start).noise
    # 60 readings of one or two channels: the sd of a standard deviation is 6 to 9 %.
    expected = NOISE[[0, 2, 3, 5]]
    np.testing.assert_allclose(noise.reading[:, 0], np.tile(expected, (2, 1)), rtol=0.3)
    assert np.all(noise.impulse < 1e-3)


def test_mass_is_found_as_closely_as_a_filter_can(box):
    """Closer than by single steps, and covered by its own standard deviation."""
    found = find_modes(jax.random.key(0), box, FitSettings(num_draws=16))
    mode = np.asarray(found.modes.z)[:, 0, 0]
    sd = 1.0 / np.sqrt(np.asarray(found.modes.precision)[:, 0, 0, 0])
    truth = np.log(MASS / AREA / 30.0) / 1.5
    assert np.all(np.abs(mode - truth) < 4.0 * sd)
    one_step = climb(
        box, make_fits(box, np.arange(2), np.zeros(2, int), mode[:, None]), 5
    )
    _, matrix = normal_equations(box, Host.of(box), one_step)
    assert np.all(sd < 0.7 / np.sqrt(matrix[:, 0, 0]))


@pytest.mark.slow
def test_gains_belong_to_their_structure(wheeled):
    num = wheeled.structures.shape[1]
    index, structure = np.repeat([0, 1], num), np.tile(np.arange(num), 2)
    z = np.where(Host.of(wheeled).in_use[structure], 0.3, 0.0)
    top = make_fits(wheeled, index, structure, z)
    reading = np.tile(NOISE[[0, 2, 3, 5]], (2 * num, 1, 1))
    noise = NoiseFit(reading, np.full((2 * num, 1, 2), 1e-4))
    tracked = with_gains(wheeled, top, noise)
    gains = tracked.log_likelihood.gains
    assert gains.first.shape[:2] == (2, num)
    assert not np.allclose(gains.last[0, 0], gains.last[0, 1])
    first = jax.tree.map(lambda leaf: leaf[0], tracked).log_likelihood
    assert int(first.structure_index(wheeled.structures[0, 1])) == 1
    # A structure without a fit keeps what it has.
    rest = np.flatnonzero((index != 1) | (structure != 1))
    some = with_gains(wheeled, top.take(rest), noise.take(rest)).log_likelihood
    had = wheeled.log_likelihood
    for new, whole, old in zip(
        *(
            jax.tree.leaves((one.gains, one.reference))
            for one in (some, tracked.log_likelihood, had)
        ),
        strict=True,
    ):
        np.testing.assert_array_equal(new[1, 1], old[1, 1])
        np.testing.assert_array_equal(new[0], whole[0])
        np.testing.assert_array_equal(new[1, 0], whole[1, 0])


def test_only_distinct_fits_are_kept():
    z = np.array([[0.0], [0.1], [5.0], [9.0]])
    fits = Fits(
        index=np.zeros(4, int),
        structure=np.zeros(4, int),
        z=z,
        value=np.array([3.0, 2.0, 1.0, -np.inf]),
        precision=np.ones((4, 1, 1)),
    )
    kept = best_of_each(fits, 1, 2, min_distance=3.0)
    np.testing.assert_array_equal(kept.z, [[0.0], [5.0]])
    assert jnp.isfinite(kept.value).all()
