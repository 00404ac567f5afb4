"""Further climbs where the first ones do not agree."""

import jax
import numpy as np
import pytest

from boomdp_jax.inference.fits.find_modes import find_single_step_modes
from boomdp_jax.inference.fits.fit import FitSettings, Host, join_fits, make_fits
from boomdp_jax.inference.fits.fit_search import search_further
from boomdp_jax.inference.fits.fit_starts import Guesses
from boomdp_jax.inference.likelihoods.evaluate import evaluate_points
from tests.inference.prior_objects import draw_tracks

NUM = 8
"""Objects."""


@pytest.fixture(scope="module")
def few():
    """Eight objects, and a fit of every structure of each: with nothing known."""
    targets = draw_tracks(np.random.default_rng(4), NUM, 20).targets
    num = targets.structures.shape[1]
    index, structure = np.repeat(np.arange(NUM), num), np.tile(np.arange(num), NUM)
    z = np.zeros((len(index), targets.slot.shape[-1]))
    return targets, make_fits(targets, index, structure, z)


def search(targets, fits, num_searches: int):
    rng, lack = np.random.default_rng(0), np.full(NUM, 1e6)
    settings = FitSettings(num_searches=num_searches)
    return search_further(rng, targets, Guesses.of(targets), fits, settings, lack)


@pytest.mark.slow
def test_copies_of_one_climb_do_not_agree(few):
    targets, fits = few
    found = search(targets, join_fits(fits, fits, fits), 1)
    new = found.take(np.arange(3 * len(fits.value), len(found.value)))
    assert set(new.index.tolist()) == set(range(NUM))


def test_where_climbs_from_anywhere_agree_there_are_no_more(few):
    targets, fits = few
    one, three = (search(targets, fits, num) for num in (1, 3))
    num_structures = targets.structures.shape[1]
    is_new = np.arange(len(one.value)) >= len(fits.value)
    # Of sixteen of a structure the first eight are from anywhere.
    is_anywhere = is_new & ((np.arange(len(one.value)) - len(fits.value)) % 16 < 8)
    group = one.index * num_structures + one.structure
    is_done = np.zeros(NUM, bool)
    for i in range(NUM):
        own = np.flatnonzero(one.index == i)
        top = own[np.argmax(one.value[own])]
        same = is_anywhere & (group == group[top])
        is_done[i] = np.sum(one.value[same] > one.value[top] - 2.0) >= 3
    assert 0 < np.sum(is_done) < NUM, "draw other objects"
    few_climbs, many_climbs = (np.bincount(f.index) for f in (one, three))
    np.testing.assert_array_equal(many_climbs == few_climbs, is_done)


def test_where_they_do_not_the_best_structures_are_climbed_again(few):
    targets, fits = few
    found = search(targets, fits, 1)
    new = found.take(np.arange(len(fits.value), len(found.value)))
    num_structures = targets.structures.shape[1]
    value = fits.value.reshape(NUM, num_structures)
    for i in range(NUM):
        best = set(np.argsort(-value[i])[:3].tolist())
        assert set(new.structure[new.index == i].tolist()) == best
        before = value[i].max()
        assert new.value[new.index == i].max() > before + 50.0
    in_use = Host.of(targets).in_use[new.structure]
    assert np.all(new.z[~in_use] == 0.0)
    again = make_fits(targets, new.index, new.structure, new.z)
    np.testing.assert_allclose(again.value, new.value, rtol=1e-4, atol=1e-2)


def test_fits_without_a_finite_value_are_let_be(few):
    targets, fits = few
    lost = fits._replace(value=np.full_like(fits.value, -np.inf))
    assert len(search(targets, lost, 2).value) == len(fits.value)


@pytest.mark.slow
def test_fewer_objects_drawn_from_the_prior_are_missed():
    """Of boxes with a wheel, by more than five nats at the true structure."""
    drawn = draw_tracks(np.random.default_rng(21), 160, 20)
    wheel = np.flatnonzero(drawn.structure >= 2)
    targets = jax.tree.map(lambda leaf: leaf[wheel], drawn.targets)
    structure, each = drawn.structure[wheel], np.arange(len(wheel))
    truth = evaluate_points(targets, each, structure, drawn.z[wheel]).log_density
    best = []
    for num_searches in (0, 3):
        settings = FitSettings(num_searches=num_searches)
        modes = find_single_step_modes(jax.random.key(0), targets, settings)
        value = np.asarray(modes.log_density)
        is_true = np.asarray(modes.structure) == structure[:, None]
        best.append(np.where(is_true, value, -np.inf).max(axis=1))
    missed = [np.sum(value < truth - 5.0) for value in best]
    assert missed[0] >= 3, "nothing to be found"
    assert missed[1] <= 0.6 * missed[0], missed
    assert missed[1] < 0.05 * len(wheel), missed
