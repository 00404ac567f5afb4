"""Kinds drawn afresh, split and merged by particles, against every partition."""

import itertools

import numpy as np
import pytest

from boomdp_jax.inference.kinds import particles as kind_particles
from boomdp_jax.inference.kinds.chains import KindSettings, start_chains
from boomdp_jax.inference.kinds.collapsed_gibbs import draw_spreads
from boomdp_jax.inference.kinds.pairs import log_pairs
from boomdp_jax.inference.kinds.particles import regather_kinds, split_or_merge_kinds
from boomdp_jax.inference.kinds.state import KindState, compact, no_tallies
from tests.inference.kind_problems import (
    NOISE,
    STRUCTURES,
    canonical,
    gaussian_problem,
)
from tests.inference.kinds.test_samplers import (
    CONCENTRATION,
    EVIDENCE,
    READING,
    check_chain_means,
    enumerate_all,
    exact_partitions,
    five_objects,
    log_parts,
)

# Three are of one kind, the fourth (and a fifth that nobody saw) of another.
PARTITION = (0, 0, 0, 1, 1)
NUM_CHAINS, NUM_PARTICLES = 192, 4


def start(rng, data) -> KindState:
    settings = KindSettings(num_chains=NUM_CHAINS, concentration=CONCENTRATION)
    return start_chains(rng, data, settings)


def exact_shares() -> np.ndarray:
    """Probability of each choice of structures of the four, given the partition."""
    value = np.array(
        [
            log_parts(PARTITION, chosen, READING, NOISE)
            + sum(EVIDENCE[i, k] for i, k in enumerate(chosen))
            for chosen in itertools.product([0, 1], repeat=4)
        ]
    )
    weight = np.exp(value - value.max())
    return weight / weight.sum()


def sampled_shares(seed: int) -> np.ndarray:
    """Of each chain, with the kinds held fast."""
    data, rng = five_objects(), np.random.default_rng(seed)
    state = start(rng, data)
    state.kind[:] = PARTITION
    # It tallies afresh.
    state = compact(rng, data, state)
    counts = np.zeros((NUM_CHAINS, 16))
    for sweep in range(250):
        regather_kinds(rng, data, state, NUM_PARTICLES)
        if sweep >= 50:
            place = state.structure[:, :4] @ np.array([8, 4, 2, 1])
            counts[np.arange(NUM_CHAINS), place] += 1.0
    return counts / counts.sum(axis=1, keepdims=True)


def sampled_partitions(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Shares of each chain of the likely partitions, and of the larger structure."""
    data, rng = five_objects(), np.random.default_rng(seed)
    state, log_pair = start(rng, data), log_pairs(data)
    likely = [p for p, weight in exact_partitions().items() if weight > 0.01]
    counts = np.zeros((NUM_CHAINS, len(likely) + 1))
    larger = np.zeros((NUM_CHAINS, 4))
    for sweep in range(400):
        state = compact(rng, data, state)
        split_or_merge_kinds(rng, data, state, NUM_PARTICLES, log_pair)
        draw_spreads(rng, data, state)
        if sweep < 60:
            continue
        larger += state.structure[:, :4]
        for chain, kind in enumerate(state.kind):
            name = canonical(kind)
            place = likely.index(name) if name in likely else -1
            counts[chain, place] += 1.0
    return counts[:, :-1] / (400 - 60), larger / (400 - 60)


@pytest.mark.slow
def test_structures_of_a_kind_have_their_exact_probabilities():
    assert len(STRUCTURES) == 2
    check_chain_means(sampled_shares(0), exact_shares())


@pytest.mark.slow
def test_a_normaliser_that_is_forgotten_is_caught(monkeypatch):
    class Forgetful(kind_particles.ObjectMove):
        @property
        def log_total(self):
            return 0.0 * super().log_total

    monkeypatch.setattr(kind_particles, "ObjectMove", Forgetful)
    with pytest.raises(AssertionError):
        check_chain_means(sampled_shares(0), exact_shares())


@pytest.mark.slow
def test_splits_and_merges_alone_give_partitions_their_exact_probabilities():
    partitions, larger = sampled_partitions(1)
    exact = exact_partitions()
    check_chain_means(partitions, np.array([w for w in exact.values() if w > 0.01]))
    expected = np.zeros(4)
    for (_, chosen), weight in enumerate_all().items():
        expected += weight * np.array(chosen)
    check_chain_means(larger, expected)


@pytest.mark.slow
def test_a_restaurant_that_is_forgotten_is_caught(monkeypatch):
    true = kind_particles._log_sides

    def even(data, tallies, i, log_alpha, is_split, step):
        crowd = tallies._replace(count=np.minimum(tallies.count, 1.0))
        return true(data, crowd, i, 0.0 * log_alpha, is_split, step)

    monkeypatch.setattr(kind_particles, "_log_sides", even)
    exact = np.array([w for w in exact_partitions().values() if w > 0.01])
    partitions, _ = sampled_partitions(1)
    with pytest.raises(AssertionError):
        check_chain_means(partitions, exact)


def test_tallies_are_those_of_the_objects_after_every_move():
    data, rng = five_objects(), np.random.default_rng(2)
    state, log_pair = compact(rng, data, start(rng, data)), log_pairs(data)
    before = state.kind.copy()
    for _ in range(4):
        assert 0 < split_or_merge_kinds(rng, data, state, NUM_PARTICLES, log_pair) < 1
        assert 0 < regather_kinds(rng, data, state, NUM_PARTICLES) < 1
        again = compact(rng, data, state)
        assert [canonical(kind) for kind in again.kind] == [
            canonical(kind) for kind in state.kind
        ]
        for whole, fresh in zip(state.tallies, again.tallies, strict=True):
            assert whole.sum(axis=1) == pytest.approx(fresh.sum(axis=1), abs=1e-9)
        index = np.tile(np.arange(4), NUM_CHAINS)
        found = data.log_likelihood(
            index, state.structure[:, :4].ravel(), state.z[:, :4].reshape(-1, 2)
        )
        assert state.log_likelihood[:, :4].ravel() == pytest.approx(found)
        state = again
    assert np.any(state.kind != before)


def test_kinds_that_were_known_before_are_neither_split_nor_merged():
    data, rng = five_objects(), np.random.default_rng(3)
    known = no_tallies(data, NUM_CHAINS, 2)
    known.count[:] = 3.0
    settings = KindSettings(num_chains=NUM_CHAINS, concentration=CONCENTRATION)
    state = start_chains(rng, data, settings, before=known)
    state = compact(rng, data, state)
    assert np.all(state.kind < 2)
    held = state.kind.copy()
    moved = split_or_merge_kinds(rng, data, state, NUM_PARTICLES, log_pairs(data))
    assert moved == 0.0
    assert np.array_equal(state.kind, held)
    # What they hold is drawn afresh all the same.
    assert regather_kinds(rng, data, state, NUM_PARTICLES) > 0.2
    assert np.array_equal(state.kind, held)


def test_objects_that_are_alike_are_asked_about_more_often():
    reading = np.array([[0.9, 0.5], [0.95, 0.45], [-0.8, -0.3], [np.nan, np.nan]])
    evidence = np.zeros((4, 2))
    label, feature = np.array([0, 0, 1, 1]), np.array([[0.5], [0.5], [-1.0], [-1.0]])
    for options in ({}, {"label": label}, {"feature": feature}):
        share = np.exp(log_pairs(gaussian_problem(reading, evidence, **options)))
        assert share.sum(axis=1) == pytest.approx(1.0)
        assert np.all(np.diag(share) == 0.0)
        assert np.all(share[~np.eye(4, dtype=bool)] > 0.0)
        assert share[0, 1] > 1.5 * share[0, 2]
        if options:
            assert share[2, 3] > 1.5 * share[2, 0]


def test_one_object_has_nothing_to_be_paired_with():
    data = gaussian_problem(np.array([[0.8, -0.4]]), np.zeros((1, 2)))
    assert np.all(log_pairs(data) == -np.inf)
    rng = np.random.default_rng(4)
    state = compact(rng, data, start(rng, data))
    assert split_or_merge_kinds(rng, data, state, NUM_PARTICLES, log_pairs(data)) == 0
