"""Proposals of noise against SciPy's t, and chunks of points against a plain loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest, multivariate_normal, multivariate_t, norm

from boomdp_jax.inference.fits.fit_noise import NoisePeaks
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit
from boomdp_jax.inference.likelihoods.chunking import (
    CHUNK_SIZE,
    MAX_MIXED_OWNERS,
    MAX_OWNERS,
    Chunking,
    for_each_chunk,
    max_chunks,
)
from boomdp_jax.inference.noise.components import fit_components, truncated
from boomdp_jax.inference.noise.proposal import NoiseProposal
from boomdp_jax.inference.noise.rounds import NoiseRounds


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


def test_components_are_those_that_draws_are_of():
    rng = np.random.default_rng(4)
    share, center = np.array([0.7, 0.3]), np.array([[0.0, 0.0], [6.0, -3.0]])
    factor = np.array([[[1.0, 0.0], [0.8, 0.6]], [[0.5, 0.0], [0.0, 2.0]]])
    which = rng.choice(2, 4000, p=[0.5, 0.5])
    noise = rng.standard_normal((4000, 2))
    values = center[which] + np.einsum("nij,nj->ni", factor[which], noise)
    # As many draws of both; weights say how probable each is.
    found = fit_components(rng, values, np.log(share[which]), 1e-6 * np.eye(2))
    grid = np.stack(np.meshgrid(*[np.linspace(-8, 10, 60)] * 2), -1).reshape(-1, 2)

    def density(shares, centers, covariances):
        each = [
            multivariate_normal(*known).pdf(grid)
            for known in zip(centers, covariances, strict=True)
        ]
        return shares @ np.array(each)

    covariance = factor @ np.swapaxes(factor, 1, 2)
    # Of the variance of all a little is added to each.
    middle = share @ center
    apart = np.einsum("k,ki,kj->ij", share, center - middle, center - middle)
    added = 0.02 * (np.einsum("k,kij->ij", share, covariance) + apart)
    expected = density(share, center, covariance + added)
    gap = np.abs(density(*found) - expected)
    # Of the mass, what is not where it should be.
    assert 0.5 * gap.sum() / expected.sum() < 0.08


def test_no_draw_has_all_the_weight():
    log_weight = np.zeros(10_000)
    log_weight[3] = 50.0
    weight = truncated(log_weight)
    assert weight.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(weight[3], 1.0)
    log_weight[3] = np.log(1000.0)
    mean = 1.0999
    expected = 100.0 * mean / (9999.0 + 100.0 * mean)
    assert truncated(log_weight)[3] == pytest.approx(expected, rel=1e-6)


def test_proposals_put_together_have_the_mean_of_their_densities(proposal):
    rng = np.random.default_rng(6)
    group = np.repeat([0, 1], 200)
    vector = proposal.sample(rng, group)
    other = proposal.refitted(rng, vector[:200], np.zeros(200), group[:200])
    whole = proposal.mixed_with(other, np.array([0.25, 0.25]))
    densities = [p.log_density(vector, group) for p in (proposal, other, whole)]
    one, two, both = np.exp(densities)
    np.testing.assert_allclose(both, 0.75 * one + 0.25 * two, rtol=1e-9)
    # Nothing was seen of the second group, which stays as it was.
    np.testing.assert_allclose(two[200:], one[200:], rtol=1e-9)
    assert np.any(np.abs(two[:200] / one[:200] - 1.0) > 0.1)


@pytest.mark.parametrize("low", [4, 5])
def test_noise_that_does_not_show_is_found_beside_a_peak(low):
    """Of a table that was pushed 70 % was there, where no climb led."""
    other = 9 - low
    peak = np.array([-4.8, -2.2, -5.1, -3.4, -5.0, -5.0])
    sd = np.array([0.08, 0.1, 0.08, 0.12, 0.3, 0.3])
    sd[other] = 1.9
    flat, wide = peak.copy(), sd.copy()
    flat[low], flat[other] = peak[low] - 3.4, peak[other] + 2.3
    wide[low], wide[other] = 2.4, 0.5

    def density(rows, x):
        parts = [(0.3, peak, sd), (0.7, flat, wide)]
        each = [
            np.log(share) + norm.logpdf(x, middle, width).sum(axis=-1)
            for share, middle, width in parts
        ]
        return np.logaddexp(*each)

    for seed in range(3):
        rng = np.random.default_rng(seed)
        start = NoiseFit.of_vector(peak[None])
        found = NoiseProposal.fit(rng, density, start)
        group = np.zeros(4096, int)
        vector = found.sample(rng, group)
        log_weight = density(group, vector) - found.log_density(vector, group)
        weight = np.exp(log_weight)
        # Without components there a few draws have nearly all the weight.
        assert weight.mean() == pytest.approx(1.0, abs=0.25)
        assert weight.sum() ** 2 / np.sum(weight**2) > 0.05 * len(group)


def test_rounds_of_one_group_leave_what_the_other_had_as_it_is(proposal):
    rng = np.random.default_rng(7)
    group = np.repeat([0, 1], 300)
    vector = proposal.sample(rng, group)
    start, log_weight = NoiseRounds.of(proposal), -0.5 * np.sum(vector**2, axis=1)
    both = start.further(rng, vector, log_weight, group)
    one = both.further(rng, vector[:300], log_weight[:300], group[:300])
    before, after = (r.whole.log_density(vector, group) for r in (both, one))
    np.testing.assert_array_equal(after[300:], before[300:])
    latest = one.latest.log_density(vector, group)
    expected = 2.0 / 3.0 * np.exp(before) + np.exp(latest) / 3.0
    np.testing.assert_allclose(np.exp(after[:300]), expected[:300], rtol=1e-9)
