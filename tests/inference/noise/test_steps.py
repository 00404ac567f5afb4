"""The first resampling of draws with noise, on normal densities with known answers."""

import numpy as np
import pytest
from scipy.stats import norm

from boomdp_jax.inference.noise import steps as noise_steps
from boomdp_jax.inference.noise.problem import (
    NoiseDraws,
    NoiseProblem,
    effective_size,
)
from boomdp_jax.inference.noise.proposal import NoiseProposal
from boomdp_jax.inference.noise.rounds import NoiseRounds
from boomdp_jax.inference.noise.steps import first_step, further_step

NUM_CHAINS, NUM_EACH = 4, 2048
MIDDLE, SD, LOG_WHOLE = 2.0, 0.4, 3.0
"""Of the noise in the last density, and what that integrates to. Against a standard
normal one, one draw in nine counts."""


class Normal(NoiseProblem):
    """Coordinates and noise are standard normal at first; noise is moved and narrowed.

    The second object's noise stays as it is.
    """

    def __init__(self, index):
        self.index = index

    def only(self, rows):
        return Normal(self.index[rows])

    def with_further_round(self, rng, draws):
        return self

    def of_rounds(self, draws, before):
        return draws

    def with_other_noise(self, rng, draws):
        vector = rng.standard_normal(draws.vector.shape)
        return self.of(draws.z, vector, draws.root)

    def of(self, z, vector, names):
        first = norm.logpdf(z[:, 0]) + norm.logpdf(vector[:, 0])
        moved = norm.logpdf(vector[:, 0], MIDDLE, SD) + LOG_WHOLE
        last = np.where(self.index == 0, moved, norm.logpdf(vector[:, 0]))
        last = last + norm.logpdf(z[:, 0])
        none = np.zeros(len(z))
        structure = self.index
        return NoiseDraws(
            structure, z, z, vector, structure, first, last, none, names, names
        )


@pytest.fixture(scope="module")
def stepped():
    rng = np.random.default_rng(0)
    index = np.repeat([0, 1], NUM_CHAINS * NUM_EACH)
    problem = Normal(index)
    z = rng.standard_normal((len(index), 1))
    draws = problem.of(z, rng.standard_normal(z.shape), np.arange(len(index)))
    return draws, first_step(rng, problem, draws, index, NUM_CHAINS)[:2]


def test_draws_get_more_noises_where_few_are_any_good(stepped):
    draws, (found, size) = stepped
    num = NUM_CHAINS * NUM_EACH
    assert effective_size(draws.ratio[:num]) < 0.25 * num
    assert size[0] > 0.25 * num
    assert size[1] == pytest.approx(num)
    # The names of the second object's draws are those that they had, each once.
    np.testing.assert_array_equal(np.sort(found.draws.root[num:]), draws.root[num:])
    assert len(np.unique(found.draws.root[:num])) > 0.2 * num


def test_they_follow_the_density_on_the_way_and_their_mean_weight_is_its_whole(stepped):
    _, (found, _) = stepped
    num, share = NUM_CHAINS * NUM_EACH, found.step[0]
    assert 0.3 < share < 1.0
    grid = np.linspace(-8.0, 8.0, 20_001)
    log_last = norm.logpdf(grid, MIDDLE, SD) + LOG_WHOLE
    density = np.exp((1.0 - share) * norm.logpdf(grid) + share * log_last)
    whole = density.sum() * (grid[1] - grid[0])
    density = density / density.sum()
    mean = density @ grid
    sd = np.sqrt(density @ (grid - mean) ** 2)
    # Weights of a step count for half of the draws.
    error = 4.0 / np.sqrt(0.5 * num)
    vector = found.draws.vector[:num, 0]
    assert np.mean(vector) == pytest.approx(mean, abs=sd * error)
    assert np.std(vector) == pytest.approx(sd, rel=error)
    assert np.std(found.draws.z[:num]) == pytest.approx(1.0, rel=error)
    evidence = np.exp(found.log_mean).mean(axis=1)
    assert evidence[0] == pytest.approx(whole, rel=error)
    assert found.step[1] == pytest.approx(1.0)
    assert evidence[1] == pytest.approx(1.0)


def test_chains_choose_among_their_own_draws(stepped):
    draws, (found, _) = stepped
    chain = np.arange(len(draws.root)) // NUM_EACH
    np.testing.assert_array_equal(found.draws.root // NUM_EACH, chain)
    # A draw's coordinates are those of its root, whatever its noise.
    np.testing.assert_array_equal(found.draws.z, draws.z[found.draws.root])
    # Some have the noise that they had, some another one.
    is_first = found.draws.vector[:, 0] == draws.vector[found.draws.root, 0]
    first = is_first[: len(chain) // 2]
    assert 0.05 < np.mean(first) < 0.5
    assert np.all(is_first[len(chain) // 2 :])


class Far(Normal):
    """All noises are as good; of coordinates one in nine counts."""

    def only(self, rows):
        return Far(self.index[rows])

    def of(self, z, vector, names):
        plain = super().of(z, vector, names)
        first = plain.log_first
        last = norm.logpdf(vector[:, 0]) + norm.logpdf(z[:, 0], MIDDLE, SD)
        return plain._replace(log_first=first, log_last=last)


def test_more_noises_do_not_pass_for_more_draws():
    rng = np.random.default_rng(2)
    index = np.zeros(NUM_CHAINS * NUM_EACH, int)
    problem = Far(index)
    z = rng.standard_normal((len(index), 1))
    draws = problem.of(z, rng.standard_normal(z.shape), np.arange(len(index)))
    alone = effective_size(draws.ratio)
    found, size, _ = first_step(rng, problem, draws, index, NUM_CHAINS)
    assert size[0] == pytest.approx(alone, rel=1e-6)
    # As long a step as with one noise each.
    one = further_step(rng, draws, np.zeros(1), NUM_CHAINS)
    assert found.step[0] == pytest.approx(one.step[0], rel=1e-6)
    num = [len(np.unique(step.draws.z)) for step in (found, one)]
    assert num[0] == pytest.approx(num[1], rel=0.05)


class Missed(NoiseProblem):
    """A third of the noise's mass is where its first proposal has one draw in 500.

    Coordinates are standard normal, and say nothing of the noise.
    """

    def __init__(self, index, rounds):
        self._index, self._rounds = index, rounds

    def only(self, rows):
        return Missed(self._index[rows], self._rounds)

    def with_further_round(self, rng, draws):
        known = draws.vector, draws.ratio, draws.group
        return Missed(self._index, self._rounds.further(rng, *known))

    def _with_last(self, draws):
        vector = draws.vector
        last = np.logaddexp(
            np.log(2 / 3) + norm.logpdf(vector).sum(axis=1),
            np.log(1 / 3) + norm.logpdf(vector, 3.5, 0.5).sum(axis=1),
        )
        last = last + LOG_WHOLE + norm.logpdf(draws.z[:, 0])
        return draws._replace(log_last=last)


@pytest.mark.parametrize("seed", range(4))
def test_further_proposals_find_what_the_first_one_missed(seed, monkeypatch):
    # Until weights are so even that the first step is the last.
    monkeypatch.setattr(noise_steps, "_ENOUGH_SHARE", 0.55)
    rng = np.random.default_rng(seed)
    index = np.zeros(NUM_CHAINS * 512, int)
    first = NoiseProposal(
        np.zeros((1, 1)), np.zeros((1, 1, 2)), 0.7 * np.eye(2)[None, None]
    )
    rounds = NoiseRounds.of(first)
    z, vector = rng.standard_normal((len(index), 1)), first.sample(rng, index)
    none = np.zeros(len(index))
    start = norm.logpdf(z[:, 0]) + first.log_density(vector, index)
    names = np.arange(len(index))
    draws = NoiseDraws(index, z, z, vector, index, start, none, none, names, names)
    problem = Missed(index, rounds)
    draws = problem._with_last(draws)
    before = effective_size(draws.ratio)
    found, size, last = first_step(rng, problem, draws, index, NUM_CHAINS)
    assert before < 0.25 * len(index) < 0.5 * len(index) < size[0]
    assert last._rounds.num > 1
    assert found.step[0] == pytest.approx(1.0)
    share = np.mean(found.draws.vector[:, 0] > 2.0)
    error = 4.0 / np.sqrt(0.25 * len(index))
    assert share == pytest.approx(1 / 3, abs=0.5 * error)
    evidence = np.exp(found.log_mean).mean()
    assert evidence == pytest.approx(np.exp(LOG_WHOLE), rel=error)


def test_objects_that_have_arrived_stay(stepped):
    draws, _ = stepped
    rng = np.random.default_rng(1)
    found = further_step(rng, draws, np.array([0.5, 1.0]), NUM_CHAINS)
    num = NUM_CHAINS * NUM_EACH
    np.testing.assert_array_equal(found.draws.root[num:], draws.root[num:])
    assert len(np.unique(found.draws.root[:num])) < num
    assert found.step[0] > 0.0
    np.testing.assert_array_equal(found.step[1], 0.0)
    np.testing.assert_array_equal(found.log_mean[1], 0.0)
