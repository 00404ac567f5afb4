"""Proposals of noise against SciPy's t, and chunks of points against a plain loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest, multivariate_t

from boomdp_jax.inference.chunking import (
    CHUNK_SIZE,
    MAX_MIXED_OWNERS,
    MAX_OWNERS,
    Chunking,
    for_each_chunk,
    max_chunks,
)
from boomdp_jax.inference.fit_noise import NoisePeaks
from boomdp_jax.inference.noise_level import NoiseFit
from boomdp_jax.inference.noise_proposal import NoiseProposal


@pytest.fixture(scope="module")
def proposal():
    """Two groups, of two components and of one."""
    rng = np.random.default_rng(0)
    factors = np.tril(rng.normal(size=(2, 2, 3, 3))) + 3.0 * np.eye(3)
    share = np.array([[0.3, 0.7], [1.0, 0.0]])
    with np.errstate(divide="ignore"):
        return NoiseProposal(np.log(share), rng.normal(size=(2, 2, 3)), factors)


def component(proposal: NoiseProposal, group: int, number: int):
    lower = proposal.lower[group, number]
    scale = np.linalg.inv(lower @ lower.T)
    return multivariate_t(proposal.center[group, number], scale, df=5.0)


def test_density_is_that_of_a_mixture_of_t(proposal):
    points = np.random.default_rng(1).normal(size=(20, 3))
    for group in range(2):
        found = proposal.log_density(points, np.full(20, group))
        share = np.exp(proposal.log_share[group])
        each = [component(proposal, group, c).pdf(points) for c in range(2)]
        np.testing.assert_allclose(found, np.log(share @ each), rtol=1e-9)


def test_draws_follow_their_group(proposal):
    rng = np.random.default_rng(2)
    group = np.repeat([0, 1], 4000)
    draws = proposal.sample(rng, group)
    for which in range(2):
        num = rng.multinomial(4000, np.exp(proposal.log_share[which]))
        theirs = np.concatenate(
            [
                component(proposal, which, c).rvs(num[c], random_state=3)
                for c in range(2)
                if num[c]
            ]
        )
        own = draws[group == which]
        for direction in np.eye(3):
            assert kstest(own @ direction, theirs @ direction).pvalue > 1e-4


@pytest.mark.parametrize("is_mixed", [False, True], ids=["of one", "mixed"])
@pytest.mark.parametrize("num_workers", [1, 2, 7])
@pytest.mark.parametrize("num_points", [0, 1, 31, 500, 3000])
def test_every_point_gets_its_own_result(num_points, num_workers, is_mixed):
    rng = np.random.default_rng(num_points)
    num_structures = 200 if is_mixed else 7
    index = rng.integers(0, 3, num_points)
    structure = rng.integers(0, num_structures, num_points)
    value = rng.normal(size=num_points)
    chunks = Chunking.of(index, structure, num_structures, is_mixed=is_mixed)
    most_owners = MAX_MIXED_OWNERS if is_mixed else MAX_OWNERS
    found, sizes = [], []
    for call in chunks.calls(num_workers):
        sizes.append(call.num)
        rows = call.rows[: call.num]
        owner = call.owner[: call.num]
        owner = owner if is_mixed else np.repeat(owner[:, None], rows.shape[1], axis=1)
        assert call.owners.shape == (most_owners, 2)
        assert len(call.owner) == len(call.rows) == max_chunks()
        assert np.all(index[rows] == call.owners[owner][..., 0])
        assert np.all(structure[rows] == call.owners[owner][..., 1])
        # What a chunk is given of its object is read off its first place.
        assert np.all(index[rows] == index[rows[:, :1]])
        found.append(value[rows])
    if num_points:
        np.testing.assert_array_equal(chunks.in_order(found), value)
        most = -(-chunks.num_chunks // num_workers)
        assert max(int(n) for n in sizes) <= max(most, 1)
    else:
        assert not found
    # No more chunks than each object needs by itself.
    counts = np.unique(index, return_counts=True)[1]
    if is_mixed:
        assert chunks.num_chunks == np.sum(-(-counts // CHUNK_SIZE))


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_chunks_that_count_are_worked_on_by_what_they_belong_to(backend, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    owner, num = jnp.array([0, 0, 1, 0], jnp.int32), jnp.int32(3)
    points = jnp.arange(8.0).reshape(4, 2)
    found = jax.jit(
        lambda known: for_each_chunk(lambda k, x: (k * x, x), known, owner, num, points)
    )(jnp.array([10.0, 100.0]))
    expected = np.array([10.0, 10.0, 100.0])[:, None] * points[:3]
    np.testing.assert_array_equal(np.asarray(found[0])[:3], expected)
    np.testing.assert_array_equal(np.asarray(found[1])[:3], points[:3])


def test_peaks_that_are_the_same_are_covered_once():
    peaks = NoisePeaks(
        NoiseFit.of_vector(np.zeros((1, 6))), np.eye(6)[None], np.array([3.0])
    )
    far = np.zeros((2, 6))
    far[1, 3] = 2.0
    others = NoisePeaks(
        NoiseFit.of_vector(far), np.tile(np.eye(6), (2, 1, 1)), np.array([3.0, 3.0])
    )
    found = NoiseProposal.of_peaks(peaks, others)
    share = np.exp(found.log_share[0]).reshape(3, 2).sum(axis=1)
    np.testing.assert_allclose(share, [0.5, 0.0, 0.5])
