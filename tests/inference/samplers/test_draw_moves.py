"""Moves of many draws by their own spread, on densities whose draws are known."""

import numpy as np
import pytest
from scipy import stats

from boomdp_jax.inference.samplers import draw_moves
from boomdp_jax.inference.samplers.draw_moves import about_means, by_differences

PERIOD = np.array([0.0, 0.0, 2.0 * np.pi])
SCALE = np.array([1.0, 1e-3, 1.0])
NUM = 4000
# Of a normal gamma's logarithm, of a skewed normal, of an angle that is spread far.
PARTS = (stats.loggamma(2.0), stats.skewnorm(3.0), stats.vonmises(0.5))


def log_density(values: np.ndarray) -> np.ndarray:
    """Of three independent numbers, the second one thousand times smaller."""
    return sum(part.logpdf(values[:, i] / SCALE[i]) for i, part in enumerate(PARTS))


def draws(rng: np.random.Generator, num: int = NUM) -> np.ndarray:
    columns = [part.rvs(num, random_state=rng) for part in PARTS]
    return np.stack(columns, axis=1) * SCALE


def propose(kind, rng, values, group):
    if kind == "mean":
        return about_means(rng, values, group, PERIOD)
    num_moved = np.full(len(values), 3)
    return by_differences(rng, values, group, PERIOD, num_moved, 0.7)


def moved(kind, rng, values, group, num_moves, *, with_ratio=True) -> np.ndarray:
    for _ in range(num_moves):
        proposed = propose(kind, rng, values, group)
        gain = log_density(proposed.values) - log_density(values)
        gain = gain + (proposed.log_ratio if with_ratio else 0.0)
        is_accepted = np.log(rng.random(len(values))) < gain
        values = np.where(is_accepted[:, None], proposed.values, values)
    return values


def distances(values: np.ndarray) -> list[float]:
    """Kolmogorov's, of each number from its law."""
    return [
        float(stats.kstest(values[:, i] / SCALE[i], part.cdf).statistic)
        for i, part in enumerate(PARTS)
    ]


@pytest.mark.parametrize("kind", ["mean", "difference"])
@pytest.mark.parametrize("width", [1.0, 0.5])
def test_draws_come_to_their_density_and_stay_there(kind, width):
    rng = np.random.default_rng(5)
    start = draws(rng) * width
    num_moves = {"mean": 40, "difference": 120}[kind]
    end = moved(kind, rng, start, np.zeros(NUM, int), num_moves)
    # One in a million for independent draws.
    assert max(distances(end)) < 2.7 / np.sqrt(NUM)
    for i in range(2):
        assert abs(np.corrcoef(start[:, i], end[:, i])[0, 1]) < 0.15


def test_forgetting_the_way_back_would_be_noticed():
    rng = np.random.default_rng(5)
    group = np.zeros(NUM, int)
    end = moved("mean", rng, draws(rng), group, 40, with_ratio=False)
    assert max(distances(end)) > 2.7 / np.sqrt(NUM)


def test_moves_about_the_mean_go_far_in_many_dimensions():
    rng = np.random.default_rng(2)
    mixing = rng.normal(size=(30, 30))
    start = rng.normal(size=(NUM, 30)) @ mixing
    proposed = about_means(rng, start, np.zeros(NUM, int), np.zeros(30))

    def value(x):
        return -0.5 * np.sum(np.linalg.solve(mixing.T, x.T) ** 2, axis=0)

    gain = value(proposed.values) - value(start) + proposed.log_ratio
    # Of a normal density only what mean and covariance of 3000 others are off counts:
    # the logarithm's sd is 0.57 where all is new, with which 0.77 would be accepted.
    assert 0.77 < np.mean(np.exp(np.minimum(gain, 0.0))) < 0.9


def test_groups_keep_to_themselves():
    rng = np.random.default_rng(4)
    group = np.repeat([0, 1, 2], [200, 200, 3])
    values = np.zeros((403, 3))
    values[group == 0, 0] = rng.normal(size=200)
    values[group == 1, 1] = 50.0 + rng.normal(size=200)
    values[group == 2] = rng.normal(size=(3, 3))
    for kind in ("mean", "difference"):
        proposed = propose(kind, rng, values, group)
        is_changed = proposed.values != values
        # The difference of a draw with itself is no step.
        assert is_changed[group == 0][:, 0].mean() > 0.95
        assert not is_changed[group == 0][:, 1:].any()
        assert is_changed[group == 1][:, 1].mean() > 0.95
        assert not is_changed[group == 1][:, [0, 2]].any()
        # Too few for a spread.
        assert not is_changed[group == 2].any()


def test_angles_about_half_a_turn_are_one_heap():
    rng = np.random.default_rng(6)
    values = np.zeros((NUM, 3))
    angle = np.pi + 0.1 * rng.normal(size=NUM)
    values[:, 2] = np.where(angle > np.pi, angle - 2.0 * np.pi, angle)
    proposed = about_means(rng, values, np.zeros(NUM, int), PERIOD)
    offset = np.abs(np.abs(proposed.values[:, 2]) - np.pi)
    assert np.all(np.abs(proposed.values[:, 2]) <= np.pi)
    np.testing.assert_allclose(np.sqrt(np.mean(offset**2)), 0.1, rtol=0.1)


@pytest.mark.parametrize("num_copies", [1, 4])
def test_a_draw_has_no_part_in_the_spread_that_moves_it(num_copies):
    """Else few draws of many numbers, moved again and again, would shrink together."""
    rng = np.random.default_rng(7)
    num, dim, group = 120, 12, np.zeros(120, int)
    root = np.arange(num) // num_copies
    ends = []
    for _ in range(60):
        values = rng.normal(size=(num, dim))[root]
        for _ in range(12):
            proposed = about_means(rng, values, group, np.zeros(dim), root)
            change = np.sum(proposed.values**2 - values**2, axis=1)
            gain = proposed.log_ratio - 0.5 * change
            is_accepted = np.log(rng.random(num)) < gain
            values = np.where(is_accepted[:, None], proposed.values, values)
        ends.append(np.mean(values**2))
    # The mean of 86,400 squares has an sd of 0.0048, that of four times fewer 0.0096;
    # with parts that know of no copies those shrink by 0.07.
    assert abs(np.mean(ends) - 1.0) < 0.02 * np.sqrt(num_copies)


def test_parts_of_a_group_are_as_equal_as_families_allow():
    rng = np.random.default_rng(9)
    root = np.repeat([5, 9, 2, 7, 1, 3], [40, 20, 20, 10, 5, 5])
    part = draw_moves._dealt(rng, root)
    assert np.all([len(np.unique(part[root == name])) == 1 for name in np.unique(root)])
    assert sorted(np.bincount(part, minlength=4)) == [20, 20, 20, 40]
    alone = draw_moves._dealt(rng, np.arange(100))
    assert np.bincount(alone).tolist() == [25] * 4
