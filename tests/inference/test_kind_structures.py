"""Structures of a kind's objects proposed together, against all of them."""

import itertools

import numpy as np
import pytest

from boomdp_jax.inference import kind_structures
from boomdp_jax.inference.collapsed_gibbs import draw_spreads
from boomdp_jax.inference.kind_chains import KindSettings, start_chains
from boomdp_jax.inference.kind_state import compact
from boomdp_jax.inference.kind_structures import restructure_kinds
from tests.inference.kind_problems import NOISE, STRUCTURES
from tests.inference.test_kind_samplers import (
    EVIDENCE,
    READING,
    check_chain_means,
    five_objects,
    log_parts,
)

# Three are of one kind, the fourth (and a fifth that nobody saw) of another.
PARTITION = (0, 0, 0, 1, 1)
NUM_CHAINS, NUM_SWEEPS = 192, 400


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
    settings = KindSettings(num_chains=NUM_CHAINS)
    state = start_chains(rng, data, settings)
    state.kind[:] = PARTITION
    # It tallies afresh.
    state = compact(rng, data, state)
    counts = np.zeros((NUM_CHAINS, 16))
    for sweep in range(NUM_SWEEPS):
        draw_spreads(rng, data, state)
        restructure_kinds(rng, data, state)
        if sweep >= 50:
            place = state.structure[:, :4] @ np.array([8, 4, 2, 1])
            counts[np.arange(NUM_CHAINS), place] += 1.0
    return counts / counts.sum(axis=1, keepdims=True)


@pytest.mark.slow
def test_structures_of_a_kind_have_their_exact_probabilities():
    assert len(STRUCTURES) == 2
    check_chain_means(sampled_shares(0), exact_shares())


@pytest.mark.slow
def test_a_normaliser_that_is_forgotten_is_caught(monkeypatch):
    class Forgetful(kind_structures.ObjectMove):
        @property
        def log_total(self):
            return 0.0 * super().log_total

    monkeypatch.setattr(kind_structures, "ObjectMove", Forgetful)
    with pytest.raises(AssertionError):
        check_chain_means(sampled_shares(0), exact_shares())
