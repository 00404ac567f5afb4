"""Both samplers of kinds against every partition, each other and the prior."""

import functools
import itertools
from collections import Counter

import numpy as np
import pytest
from scipy import special, stats

from boomdp_jax.inference.kinds.chains import KindSettings, run_kind_chains
from boomdp_jax.inference.kinds.coordinates import CoordinateModel
from boomdp_jax.inference.kinds.likelihood_bumps import bump_of_posterior, join_bumps
from boomdp_jax.inference.kinds.prior import KindPrior
from boomdp_jax.inference.kinds.state import KindData, log_joint, no_tallies
from tests.inference.kind_problems import (
    NOISE,
    SPREADS,
    STRUCTURE_PRIOR,
    STRUCTURES,
    WEIGHTS,
    canonical,
    gaussian_problem,
    log_counts,
    log_group,
    log_restaurant,
    partitions,
)

CONCENTRATION = 1.3
READING = np.array([[0.9, 0.5], [1.1, 0.4], [-0.8, -0.3], [-0.9, 1.2], [np.nan] * 2])
EVIDENCE = np.array([[0.0, 0.5], [0.0, 1.0], [0.3, 0.0], [0.0, 0.0], [0.0, 0.0]])
LABEL = np.array([0, 0, 1, -1, 1])
FEATURE = np.array([[0.5], [0.6], [-0.7], [-0.2], [-0.6]])
PRIOR = KindPrior(structure_weight=0.5, label_weight=0.5, vocabulary=4)
LABEL_BASE = np.array([0.125, 0.125, 0.25])


def five_objects() -> KindData:
    """The last has no reading; bumps are off centre and too wide."""
    return gaussian_problem(
        READING,
        EVIDENCE,
        prior=PRIOR,
        label=LABEL,
        feature=FEATURE,
        shift=0.5,
        widening=1.4,
    )


@functools.cache
def enumerate_all() -> dict[tuple, float]:
    """Probability of every partition of the five with every choice of structures."""
    out = {}
    for partition in partitions(5):
        for chosen in itertools.product([0, 1], repeat=4):
            value = log_parts(partition, chosen, READING, NOISE)
            out[partition, chosen] = value + sum(
                EVIDENCE[i, k] for i, k in enumerate(chosen)
            )
    weight = np.array(list(out.values()))
    weight = np.exp(weight - np.logaddexp.reduce(weight))
    return dict(zip(out, weight, strict=True))


def log_parts(partition, chosen, values, noise: float) -> float:
    """Prior of partition and structures times the density of values given them."""
    out = log_restaurant(partition, CONCENTRATION)
    for kind in set(partition):
        members = [i for i in range(5) if partition[i] == kind]
        seen = [i for i in members if i < 4]
        base = PRIOR.structure_weight * STRUCTURE_PRIOR
        out += log_counts([chosen[i] for i in seen], base)
        out += log_counts([LABEL[i] for i in members if LABEL[i] >= 0], LABEL_BASE)
        out += group_of(tuple(FEATURE[members, 0]), 0.0)
        for j in range(2):
            rows = [i for i in seen if STRUCTURES[chosen[i], j]]
            if rows:
                out += group_of(tuple(values[rows, j]), noise)
    return out


@functools.cache
def group_of(values: tuple[float, ...], noise: float) -> float:
    return log_group(np.array(values), noise)


def exact_partitions() -> dict[tuple[int, ...], float]:
    """Probability of every partition of the five."""
    out: dict[tuple[int, ...], float] = {}
    for (partition, _), weight in enumerate_all().items():
        out[partition] = out.get(partition, 0.0) + weight
    return out


def check_chain_means(values: np.ndarray, expected, false_alarm: float = 1e-4) -> None:
    """Means of independent chains `[chain, statistic]` against the truth."""
    num_chains = len(values)
    error = values.std(0, ddof=1) / np.sqrt(num_chains)
    z = np.abs(values.mean(0) - expected) / np.maximum(error, 1e-12)
    assert np.max(z) < stats.t.isf(0.5 * false_alarm / len(z), num_chains - 1), (
        f"{values.mean(0)} against {expected}"
    )


@pytest.fixture(scope="module", params=["collapsed", "sticks"])
def sampled(request):
    # Four times the chains are two thirds more work for each sweep.
    settings = KindSettings(
        num_chains=256,
        num_warmup=40,
        num_samples=40,
        sampler=request.param,
        concentration=CONCENTRATION,
    )
    data = five_objects()
    return data, run_kind_chains(np.random.default_rng(1), data, settings)


@pytest.mark.slow
def test_partitions_have_their_exact_probabilities(sampled):
    _, draws = sampled
    exact = exact_partitions()
    likely = [p for p, weight in exact.items() if weight > 0.01]
    names = np.array(
        [
            [likely.index(p) if p in likely else -1 for p in row]
            for row in [[canonical(kind) for kind in chain] for chain in draws.kind]
        ]
    )
    shares = np.stack([(names == k).mean(1) for k in range(len(likely))], axis=1)
    check_chain_means(shares, np.array([exact[p] for p in likely]))


def test_bumps_that_are_off_do_not_bias_structures(sampled):
    _, draws = sampled
    exact = np.zeros(4)
    for (_, chosen), weight in enumerate_all().items():
        exact += weight * np.array(chosen)
    check_chain_means(draws.structure[:, :, :4].mean(1), exact)


def test_the_joint_density_of_a_state_is_the_product_of_its_parts(sampled):
    data, draws = sampled
    state = draws.state
    found = log_joint(data, state)
    for chain in range(3):
        partition = canonical(state.kind[chain])
        chosen = state.structure[chain]
        expected = log_parts(partition, chosen, state.z[chain], 0.0)
        expected += state.log_likelihood[chain].sum()
        assert found[chain] == pytest.approx(expected, rel=1e-9)


def no_readings(num_objects: int) -> KindData:
    return gaussian_problem(
        np.full((num_objects, 2), np.nan), np.zeros((num_objects, 2))
    )


def flat_readings(num_objects: int) -> KindData:
    """Objects whose likelihood is flat, but which are sampled all the same."""
    data = gaussian_problem(np.zeros((num_objects, 2)), np.zeros((num_objects, 2)))
    bumps = tuple(
        b._replace(
            factor=0 * b.factor,
            residual=0 * b.residual,
            log_height=0 * b.log_height,
            square=0 * b.square,
        )
        for b in data.bumps
        if b is not None
    )
    return data._replace(
        bumps=bumps, log_likelihood=lambda index, structure, z: np.zeros(len(index))
    )


def restaurant_counts(num_objects: int, concentration: float) -> np.ndarray:
    """P(number of kinds), by the recursion of Stirling numbers of the first kind."""
    stirling = np.zeros(num_objects + 1)
    stirling[0] = 1.0
    for n in range(num_objects):
        stirling = np.append(0.0, stirling[:-1]) + n * stirling
    weight = stirling * concentration ** np.arange(num_objects + 1)
    return weight / weight.sum()


@pytest.mark.parametrize("sampler", ["collapsed", "sticks"])
@pytest.mark.parametrize(
    "make", [no_readings, pytest.param(flat_readings, marks=pytest.mark.slow)]
)
def test_without_data_the_number_of_kinds_is_the_chinese_restaurants(sampler, make):
    settings = KindSettings(64, 30, 100, sampler, num_kinds=25, concentration=0.8)
    draws = run_kind_chains(np.random.default_rng(2), make(8), settings)
    num_kinds = np.array(
        [[len(set(kind)) for kind in chain] for chain in draws.kind.tolist()]
    )
    shares = np.stack([(num_kinds == k).mean(1) for k in range(1, 5)], axis=1)
    check_chain_means(shares, restaurant_counts(8, 0.8)[1:5])
    z = draws.z[..., 0].reshape(64, -1)
    values = np.stack([z.mean(1), (z**2).mean(1)], axis=1)
    check_chain_means(values, np.array([0.0, 1.0]))
    used = draws.structure.reshape(64, -1).mean(1)[:, None]
    check_chain_means(used, STRUCTURE_PRIOR[1:])


@pytest.mark.slow
@pytest.mark.parametrize("sampler", ["collapsed", "sticks"])
def test_without_data_the_concentration_keeps_its_gamma_prior(sampler):
    settings = KindSettings(64, 50, 300, sampler, num_kinds=60)
    draws = run_kind_chains(np.random.default_rng(3), no_readings(6), settings)
    alpha = draws.concentration
    # Gamma of shape 2 and rate 2.
    values = np.stack([alpha.mean(1), (alpha < 0.5).mean(1)], axis=1)
    expected = np.array([1.0, special.gammainc(2.0, 1.0)])
    check_chain_means(values, expected)


@pytest.mark.slow
def test_one_object_keeps_its_own_posterior():
    reading = np.array([[0.8, -0.4]])
    evidence = np.array([[0.0, 0.7]])
    data = gaussian_problem(reading, evidence, shift=0.4, widening=1.3)
    settings = KindSettings(64, 30, 150)
    draws = run_kind_chains(np.random.default_rng(4), data, settings)
    log_weight = np.log(STRUCTURE_PRIOR) + evidence[0]
    density = stats.norm.logpdf(reading[0], 0, np.sqrt(1 + NOISE**2))
    log_weight = log_weight + np.array([density[0], density.sum()])
    share = np.exp(log_weight - np.logaddexp.reduce(log_weight))
    check_chain_means(draws.structure[:, :, 0].mean(1)[:, None], share[1:])
    variance = 1 / (1 + NOISE**-2)
    z = draws.z[:, :, 0, 0]
    values = np.stack([z.mean(1), (z**2).mean(1)], axis=1)
    mean = variance * reading[0, 0] / NOISE**2
    check_chain_means(values, np.array([mean, mean**2 + variance]))


@pytest.mark.slow
def test_objects_come_out_in_any_order():
    """Relabelling objects relabels the answer."""
    order = np.array([3, 1, 4, 0, 2])
    data = gaussian_problem(
        READING[order],
        EVIDENCE[order],
        prior=PRIOR,
        label=LABEL[order],
        feature=FEATURE[order],
    )
    settings = KindSettings(64, 60, 150, concentration=CONCENTRATION)
    draws = run_kind_chains(np.random.default_rng(5), data, settings)
    back = draws.kind[..., np.argsort(order)]
    together = (back[..., :, None] == back[..., None, :]).mean(1)
    expected = np.zeros((5, 5))
    for partition, weight in exact_partitions().items():
        row = np.array(partition)
        expected += weight * (row[:, None] == row[None])
    pairs = np.triu_indices(5, 1)
    check_chain_means(together[:, pairs[0], pairs[1]], expected[pairs])


def test_counter_of_partitions_is_complete():
    """Bell number of five."""
    assert len(Counter(partitions(5))) == 52


HEADING = np.array([1.5, -1.4])
"""Either side of where headings are cut, 0.24 rad apart."""
TURN, SHARPNESS = 2.0, 6.0


def log_heading(index: np.ndarray, z: np.ndarray) -> np.ndarray:
    return SHARPNESS * np.cos(TURN * (z - HEADING[index]))


def headings() -> KindData:
    """Two objects of which only a heading is known, not too well."""
    period = np.array([np.pi])
    bumps = []
    for heading in HEADING:
        # A normal posterior near the true one, its evidence by quadrature.
        covariance = np.array([[1.3 / (SHARPNESS * TURN**2)]])
        evidence = float(np.log(special.i0(SHARPNESS)))
        mean = np.array([heading + 0.05])
        bump = bump_of_posterior(
            0, np.array([True]), period, mean, covariance, evidence
        )
        bumps.append(join_bumps([bump]))
    return KindData(
        coordinates=CoordinateModel(
            period, np.array([[0.1, np.inf]]), np.log([[0.7, 0.3]])
        ),
        in_use=np.array([[True]]),
        log_prior=np.zeros(1),
        bumps=tuple(bumps),
        label=np.full(2, -1),
        num_labels=0,
        feature=np.zeros((2, 0)),
        log_likelihood=lambda index, structure, z: log_heading(index, z[:, 0]),
        prior=KindPrior(),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "sampler", ["collapsed", pytest.param("sticks", marks=pytest.mark.slow)]
)
def test_headings_that_meet_at_the_cut_are_taken_together(sampler):
    grid = (np.arange(300) + 0.5) / 300 * np.pi - np.pi / 2
    likelihood = np.exp([log_heading(np.full(300, i), grid) for i in range(2)])
    kappa = (TURN * 0.1) ** -2
    within = stats.vonmises.pdf(TURN * (grid[:, None] - grid[None]), kappa) * TURN
    # Averages over the grid are integrals over the uniform prior.
    given = likelihood @ within * np.pi / 300
    apart = likelihood.mean(1).prod()
    close = (given[0] * given[1]).mean()
    same = (0.7 * close + 0.3 * apart) / (1 + CONCENTRATION)
    other = apart * CONCENTRATION / (1 + CONCENTRATION)
    sine = np.sin(TURN * grid)
    first = (likelihood[0] * sine) @ within * np.pi / 300
    moved = (0.7 * (first * given[1]).mean()) / (1 + CONCENTRATION)
    alone = (likelihood[0] * sine).mean() * likelihood[1].mean()
    moved += alone * (0.3 / (1 + CONCENTRATION) + CONCENTRATION / (1 + CONCENTRATION))
    settings = KindSettings(
        64, 40, 250, sampler, num_kinds=25, concentration=CONCENTRATION
    )
    draws = run_kind_chains(np.random.default_rng(6), headings(), settings)
    found = np.stack(
        [
            (draws.kind[..., 0] == draws.kind[..., 1]).mean(1),
            np.sin(TURN * draws.z[:, :, 0, 0]).mean(1),
        ],
        axis=1,
    )
    check_chain_means(found, np.array([same, moved]) / (same + other))


BEFORE = (np.array([0.9, 1.0]), np.array([-1.0, -0.8, -0.9]))
"""Exact coordinates of objects known before, kind by kind."""


def log_known_and_read(known: np.ndarray, reading: float) -> float:
    """Density of exact values and of a noisy one of the same kind, over spreads."""
    n = len(known) + 1
    noise = np.zeros(n)
    noise[-1] = NOISE**2
    each = []
    for spread, weight in zip(SPREADS, WEIGHTS, strict=True):
        covariance = spread**2 * np.eye(n) + (1 - spread**2) + np.diag(noise)
        normal = stats.multivariate_normal(np.zeros(n), covariance)
        each.append(np.log(weight) + normal.logpdf(np.append(known, reading)))
    return float(np.logaddexp.reduce(each))


@pytest.mark.slow
@pytest.mark.parametrize("concentration", [CONCENTRATION, 0.0])
def test_an_object_is_recognised_among_kinds_known_before(concentration):
    reading, num_chains = 0.1, 64
    # All have the first structure, in which only the first coordinate counts.
    data = gaussian_problem(np.array([[reading, 0.0]]), np.array([[0.0, -60.0]]))
    before = no_tallies(data, num_chains, 2)
    for kind, values in enumerate(BEFORE):
        before.count[:, kind] = len(values)
        before.structure[:, kind, 0] = len(values)
        before.num[:, kind, 0] = len(values)
        before.first[:, kind, 0] = values.sum()
        before.second[:, kind, 0] = (values**2).sum()
    weight = []
    for values in BEFORE:
        structure = log_counts([0] * (len(values) + 1), 0.2 * STRUCTURE_PRIOR)
        structure -= log_counts([0] * len(values), 0.2 * STRUCTURE_PRIOR)
        both = log_known_and_read(values, reading) - log_group(values, 0.0)
        weight.append(len(values) * np.exp(both + structure))
    alone = np.exp(log_group(np.array([reading]), NOISE)) * STRUCTURE_PRIOR[0]
    weight.append(concentration * alone)
    exact = np.array(weight) / np.sum(weight)
    settings = KindSettings(num_chains, 20, 200, concentration=concentration)
    spread = data.coordinates.draw_spread(np.random.default_rng(7), (num_chains, 2))
    draws = run_kind_chains(
        np.random.default_rng(8), data, settings, before, spread.astype(int)
    )
    kind = np.minimum(draws.kind[..., 0], 2)
    shares = np.stack([(kind == k).mean(1) for k in range(2)], axis=1)
    check_chain_means(shares, exact[:2])
