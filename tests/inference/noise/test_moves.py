"""The kind of move that goes farther is made, and the other one now and then."""

import numpy as np

from boomdp_jax.inference.noise.moves import MoveKinds, reach


def test_a_single_draw_reaches_nowhere(recwarn):
    point = np.zeros((1, 3))
    assert reach(point, point + 1.0) == 0.0
    assert not recwarn.list


def test_reach_is_relative_to_the_spread():
    rng = np.random.default_rng(0)
    scale = np.array([1.0, 1e-3, 50.0, 0.0])
    before = rng.normal(size=(20_000, 4)) * scale
    share = 0.6
    kick = share * rng.normal(size=before.shape) * scale
    after = np.sqrt(1.0 - share**2) * before + kick
    # E (x' - x)^2 = 2 (1 - sqrt(1 - b^2)), and a number that does not vary is left out.
    assert abs(reach(before, after) - 2.0 * (1.0 - 0.8)) < 0.02


def chosen(kinds, values, group, far):
    """Which groups move about means, when each kind goes as far as `far` says."""
    is_about_mean = kinds.choose(values, group)
    step = np.where(is_about_mean[group], *(np.asarray(f)[group] for f in far))
    sd = np.array([values[group == g].std() for g in range(len(is_about_mean))])
    after = values + (np.sqrt(step) * sd[group])[:, None]
    kinds.learn(is_about_mean, values, after, group)
    return is_about_mean.tolist()


def test_each_group_makes_the_moves_that_go_farther():
    rng = np.random.default_rng(1)
    group = np.repeat([0, 1], 400)
    values = rng.normal(size=(800, 3))
    kinds = MoveKinds(2)
    # About means the first group goes some way, the second hardly.
    far = (0.08, 0.02), (0.01, 0.4)
    made = [chosen(kinds, values, group, far) for _ in range(12)]
    # All begin about means; the fourth tells of the others, and that is that: neither
    # is close to the other.
    assert made[:3] == [[True, True]] * 3
    assert made[3] == [False, False]
    assert made[4:] == [[True, False]] * 8


def test_kinds_that_go_about_as_far_are_tried_again():
    values = np.random.default_rng(2).normal(size=(400, 3))
    kinds, group = MoveKinds(1), np.zeros(400, int)
    made = [chosen(kinds, values, group, ([0.08], [0.06]))[0] for _ in range(12)]
    assert made == [True, True, True, False] * 3


def test_moves_that_go_far_are_not_given_up_for_a_try():
    values = np.random.default_rng(2).normal(size=(400, 3))
    kinds, group = MoveKinds(1), np.zeros(400, int)
    made = [chosen(kinds, values, group, ([0.3], [0.2]))[0] for _ in range(12)]
    assert all(made)


def test_groups_too_small_for_a_mean_move_by_differences():
    rng = np.random.default_rng(3)
    group = np.repeat([0, 2], [400, 12])
    kinds = MoveKinds(4)
    # Of the others there is none, as after a structure has died out.
    found = kinds.choose(rng.normal(size=(412, 3)), group)
    assert found.tolist() == [True, False, False, False]
