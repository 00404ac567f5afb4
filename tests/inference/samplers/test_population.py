"""Walkers against importance sampling with many draws, on data that leave doubt."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.inference.blocks.block import make_block, stack_blocks
from boomdp_jax.inference.fits.find_modes import find_modes
from boomdp_jax.inference.fits.fit import FitSettings
from boomdp_jax.inference.likelihoods.evaluate import evaluate_points
from boomdp_jax.inference.samplers import population as population_module
from boomdp_jax.inference.samplers.importance_evidence import (
    importance_draws,
    weigh_draws,
)
from boomdp_jax.inference.samplers.mixture_building import (
    add_prior_components,
    add_slot_components,
    add_spare_components,
    laplace_mixture,
)
from boomdp_jax.inference.samplers.population import (
    PopulationSettings,
    sample_population,
)
from boomdp_jax.inference.samplers.spare_fit import fit_spare
from tests.inference.recordings import box_scene, free_box

pytestmark = pytest.mark.slow

NUM_DRAWS, NUM_BATCHES = 60_000, 2


@pytest.fixture(scope="module")
def problem():
    """Few and noisy readings of a box that may have a wheel, and its modes."""
    noise = 10.0 * np.array([1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 5e-3])
    history = free_box(np.random.default_rng(3), 6, noise=noise)
    targets = stack_blocks([make_block(box_scene({"wheel": 1}), (0,), history)])
    found = find_modes(jax.random.key(1), targets, FitSettings(num_draws=32))
    target = jax.tree.map(lambda leaf: leaf[0], found.targets)
    modes = jax.tree.map(lambda leaf: leaf[0], found.modes)
    laplace = laplace_mixture(
        target, modes.structure, modes.z, modes.precision, modes.log_density
    )
    return found.targets, target, laplace


@pytest.fixture(scope="module")
def reference(problem):
    """Structure probabilities and posterior means by importance sampling."""
    targets, target, laplace = problem
    # A wheel that can hardly be seen follows its prior: bumps alone would miss it.
    mixture = add_slot_components(target, laplace, total_weight=0.9)
    parts = [
        importance_draws(key, target, mixture, NUM_DRAWS, even_share=0.9)
        for key in jax.random.split(jax.random.key(5), NUM_BATCHES)
    ]
    draws = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    structure = np.asarray(draws.structure)
    index = np.zeros(structure.size, int)
    value = evaluate_points(targets, index, structure, np.asarray(draws.z)).log_density
    return weigh_draws(target, draws, jnp.asarray(value))


@pytest.fixture(scope="module")
def population(problem):
    targets, target, laplace = problem
    mixture = add_slot_components(target, laplace, total_weight=0.4)
    mixture = add_prior_components(target, mixture, total_weight=0.02)
    mixture = add_spare_components(target, mixture)
    settings = PopulationSettings(num_walkers=64, num_warmup=4, num_sweeps=80)
    stacked = jax.tree.map(lambda leaf: leaf[None], mixture)
    return sample_population(jax.random.key(2), targets, stacked, settings)


def test_structures_are_visited_by_their_probability(reference, population):
    expected = np.asarray(reference.probability)
    assert 0.05 < expected[1] < 0.95, "the data were to leave doubt"
    assert np.all(np.asarray(reference.structure_sample_size) > 100)
    wheeled = np.asarray(population.draws.structure[0]) == 1
    by_chain = wheeled.mean(axis=1)
    # Chains are independent: their spread says how far their mean may be off.
    error = by_chain.std(ddof=1) / np.sqrt(len(by_chain))
    error += float(reference.probability_error[1])
    assert abs(by_chain.mean() - expected[1]) < 4.0 * error


def test_coordinates_follow_the_posterior_of_their_structure(reference, population):
    weight = np.exp(np.asarray(reference.log_weight))
    structure, z = np.asarray(reference.structure), np.asarray(reference.z)
    draws = population.draws
    for k in (0, 1):
        mine = weight * (structure == k)
        mean = mine @ z / mine.sum()
        sd = np.sqrt(mine @ (z - mean) ** 2 / mine.sum())
        found = np.asarray(draws.z[0])[np.asarray(draws.structure[0]) == k]
        # The reference has some 500 effective draws with a wheel: 0.25 is four standard
        # errors of both together. A heading, on a circle, has no mean.
        in_use = (sd > 0) & (np.arange(z.shape[1]) != 3)
        gap = np.abs(found.mean(axis=0) - mean)[in_use] / sd[in_use]
        assert np.all(gap < 0.25)
        ratio = found.std(axis=0)[in_use] / sd[in_use]
        np.testing.assert_allclose(ratio, 1.0, atol=0.25)


def test_every_move_is_made_and_accepted(population):
    proposed, accepted = population.counts
    for move in (0, 1, 2):
        assert proposed[0, move].sum() > 0
        assert 0.02 < accepted[0, move].sum() / proposed[0, move].sum() < 0.999
    # Jumps and changes go between structures, walks stay.
    assert accepted[0, 0, 1] > 0
    assert accepted[0, 1, 1] > 0
    assert proposed[0, 2, 1] == 0


@pytest.mark.parametrize("num_refusals", [0, 1, 2, 5])
def test_sweeps_double_until_the_chains_agree(problem, num_refusals, monkeypatch):
    targets, target, laplace = problem
    mixture = add_spare_components(target, laplace)
    stacked = jax.tree.map(lambda leaf: leaf[None], mixture)
    settings = PopulationSettings(
        num_chains=2, num_walkers=8, num_warmup=1, num_sweeps=3, num_importance=64
    )
    shapes, seen, fitted, num_calls = [], [], [], 0

    def fit_and_tell(targets, mixtures, structure, z):
        fitted.append(np.sort(z, axis=None))
        return fit_spare(targets, mixtures, structure, z)

    monkeypatch.setattr(population_module, "fit_spare", fit_and_tell)

    def is_mixed(draws):
        shapes.append(draws.z.shape)
        seen.append(np.sort(draws.z, axis=None))
        return len(shapes) > num_refusals

    def evaluate(targets, structure, z):
        nonlocal num_calls
        # Not those that adapt the mixture beforehand, with other numbers of points.
        num_calls += structure.shape[1] == 16
        return jnp.zeros(structure.shape, z.dtype)

    found = sample_population(
        jax.random.key(4),
        targets,
        stacked,
        settings,
        evaluate=evaluate,
        is_mixed=is_mixed,
    )
    num_doublings = min(num_refusals, settings.max_doublings)
    assert len(shapes) == num_doublings + 1
    # However many sweeps are made, as many are kept.
    assert set(shapes) == {(1, 2, 24, targets.slot.shape[1])}
    # After warm-up, and each time on all draws so far, the moves are fitted anew.
    assert len(fitted) == num_doublings + 1
    for places, draws in zip(fitted[1:], seen, strict=False):
        np.testing.assert_array_equal(places, draws)
    num_sweeps = settings.num_warmup + settings.num_sweeps * 2**num_doublings
    assert num_calls == 5 * num_sweeps
    assert found.counts.proposed.sum() <= 5 * 16 * (num_sweeps - settings.num_warmup)
    assert found.counts.proposed.sum() > 3 * 16 * (num_sweeps - settings.num_warmup)


def test_objects_whose_chains_agree_are_left_alone(problem):
    targets, target, laplace = problem
    mixture = add_spare_components(target, laplace)
    two = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), mixture)
    both = jax.tree.map(lambda leaf: jnp.concatenate([leaf] * 2), targets)
    settings = PopulationSettings(
        num_chains=2, num_walkers=8, num_warmup=1, num_sweeps=3, num_importance=64
    )
    seen, asked = [], []

    def are_mixed(draws):
        seen.append(np.asarray(draws.z))
        return np.array([len(seen) > 1, len(seen) > 2])

    def evaluate(targets, structure, z, is_asked=None):
        if structure.shape[1] == 16:
            asked.append([True, True] if is_asked is None else is_asked.tolist())
        value = jnp.zeros(structure.shape, z.dtype)
        if is_asked is None:
            return value
        return jnp.where(jnp.asarray(is_asked)[:, None], value, -jnp.inf)

    found = sample_population(
        jax.random.key(4), both, two, settings, evaluate=evaluate, is_mixed=are_mixed
    )
    # The first is done after two rounds, the second goes on for twice as long.
    assert asked.count([True, True]) == 5 * (1 + 3 + 3)
    assert asked.count([False, True]) == 5 * 6
    np.testing.assert_array_equal(seen[2][0], seen[1][0])
    assert not np.array_equal(seen[2][1], seen[1][1])
    np.testing.assert_array_equal(np.asarray(found.draws.z), seen[2])
    proposed = found.counts.proposed.sum(axis=(1, 2))
    assert proposed[1] == pytest.approx(2 * proposed[0], rel=0.1)


def test_changes_that_nobody_accepts_are_given_up_after_warm_up(problem):
    targets, target, laplace = problem
    mixture = add_spare_components(target, laplace)
    stacked = jax.tree.map(lambda leaf: leaf[None], mixture)
    settings = PopulationSettings(
        num_chains=2, num_walkers=70, num_warmup=2, num_sweeps=3, num_importance=64
    )
    num_calls = 0

    def evaluate(targets, structure, z):
        nonlocal num_calls
        num_calls += structure.shape[1] == 140
        # One structure has all.
        return jnp.where(structure == 1, 0.0, -1e4).astype(z.dtype)

    found = sample_population(
        jax.random.key(4), targets, stacked, settings, evaluate=evaluate
    )
    assert num_calls == 5 * 2 + 4 * 3
    assert found.counts.proposed[0, 1].sum() == 0
    assert np.all(np.asarray(found.draws.structure) == 1)
