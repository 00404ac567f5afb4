"""Orders of trials against all orders there are; values of regions by hand."""

import itertools
import math

import numpy as np
import pytest

from boomdp_jax.planning import Trial, best_order, region_values, worth_of_test

GIVE_UP = 20.0


def expected_cost(order, values, give_up=GIVE_UP):
    """Of trying these in this order; the first that works ends it."""
    total, chance, lost = 0.0, 1.0, 0.0
    for trial in order:
        success = lost + trial.cost + values.get(trial.end, give_up)
        total += chance * trial.probability * success
        chance *= 1.0 - trial.probability
        lost += trial.loss
    return total + chance * (lost + give_up)


def all_orders(trials):
    """Every sequence of trials of different things, the empty one included."""
    for size in range(len({trial.thing for trial in trials}) + 1):
        for order in itertools.permutations(trials, size):
            if len({trial.thing for trial in order}) == size:
                yield order


def least_cost(trials, values):
    return min(expected_cost(order, values) for order in all_orders(trials))


def random_trials(random, num_things, num_ways=1):
    return [
        Trial(
            thing=thing,
            start=0,
            end=int(random.integers(1, 5)),
            # Sure ones and hopeless ones among them.
            probability=float(np.clip(random.uniform(-0.2, 1.2), 0.0, 1.0)),
            cost=float(random.uniform(0.0, 15.0)),
            loss=float(random.uniform(0.0, 8.0)),
        )
        for thing in range(num_things)
        for _ in range(num_ways)
    ]


def random_values(random):
    """Of some regions; from others there is no way on."""
    return {region: float(random.uniform(0.0, 25.0)) for region in (1, 2, 3)}


def test_no_order_of_any_trials_is_cheaper():
    random = np.random.default_rng(0)
    for _ in range(150):
        trials = random_trials(random, int(random.integers(1, 6)))
        values = random_values(random)
        found = best_order(trials, values, GIVE_UP)
        assert abs(found.value - least_cost(trials, values)) < 1e-9
        assert abs(found.value - expected_cost(found.trials, values)) < 1e-9


def test_what_is_not_worth_a_trial_is_left_out():
    dear = Trial(0, 0, 1, probability=0.5, cost=30.0, loss=1.0)
    hopeless = Trial(1, 0, 1, probability=0.0, cost=0.0, loss=0.0)
    found = best_order([dear, hopeless], {1: 0.0}, GIVE_UP)
    assert found.trials == ()
    assert found.value == GIVE_UP


def test_a_thing_is_tried_in_the_way_that_is_best_among_the_others():
    random = np.random.default_rng(1)
    num_best = 0
    for _ in range(100):
        trials = random_trials(random, 3, num_ways=2)
        values = random_values(random)
        found = best_order(trials, values, GIVE_UP)
        assert abs(found.value - expected_cost(found.trials, values)) < 1e-9
        assert len({trial.thing for trial in found.trials}) == len(found.trials)
        # No other way of trying one thing is cheaper, wherever it comes then.
        for thing in range(3):
            rest = [trial for trial in found.trials if trial.thing != thing]
            own = [trial for trial in trials if trial.thing == thing]
            assert found.value <= least_cost([*rest, *own], values) + 1e-9
        num_best += found.value < least_cost(trials, values) + 1e-9
    # Exchanges at one thing at a time can end elsewhere than at the best of all.
    assert num_best >= 95


def test_a_sure_way_comes_before_a_cheap_one_that_hardly_ever_works():
    cheap = Trial(0, 0, 1, probability=0.1, cost=1.0, loss=0.0)
    sure = Trial(0, 0, 1, probability=1.0, cost=2.0, loss=0.0)
    found = best_order([cheap, sure], {1: 0.0}, GIVE_UP)
    assert found.trials == (sure,)
    assert found.value == 2.0


def test_values_of_a_chain_are_those_of_its_links():
    first = Trial(0, 0, 1, probability=0.5, cost=4.0, loss=1.0)
    second = Trial(1, 1, 2, probability=0.8, cost=5.0, loss=2.0)
    values = region_values([first, second], 2, GIVE_UP)
    near = 0.8 * 5.0 + 0.2 * (2.0 + GIVE_UP)
    far = 0.5 * (4.0 + near) + 0.5 * (1.0 + GIVE_UP)
    assert values.keys() == {0, 1, 2}
    np.testing.assert_allclose([values[i] for i in range(3)], [far, near, 0.0])


def test_values_of_a_diamond_take_the_better_side_first_and_then_the_other():
    upper = [Trial(0, 0, 1, 1.0, 3.0, 0.0), Trial(1, 1, 3, 0.5, 2.0, 1.0)]
    lower = [Trial(2, 0, 2, 0.5, 1.0, 2.0), Trial(3, 2, 3, 1.0, 4.0, 0.0)]
    values = region_values([*upper, *lower], 3, GIVE_UP)
    above = 0.5 * 2.0 + 0.5 * (1.0 + GIVE_UP)
    # Through the lower side it costs 1 + 4, or 2 more than the upper side does.
    start = 0.5 * 5.0 + 0.5 * (2.0 + 3.0 + above)
    wanted = [start, above, 4.0, 0.0]
    np.testing.assert_allclose([values[i] for i in range(4)], wanted)


def test_no_way_to_the_goal_is_giving_up():
    values = region_values([Trial(0, 0, 1, 0.9, 1.0, 0.0)], 2, GIVE_UP)
    assert values == {0: GIVE_UP, 1: GIVE_UP, 2: 0.0}


def test_worth_of_a_test_is_what_knowing_saves_on_average():
    random = np.random.default_rng(2)
    signs = set()
    for _ in range(60):
        trials = random_trials(random, 3)
        values = random_values(random)
        cost = float(random.uniform(0.0, 2.0))
        tested = trials[0]._replace(
            test=cost, probability=float(random.uniform(0.1, 0.9))
        )
        trials = [tested, *trials[1:]]
        told = [
            least_cost([tested._replace(probability=known), *trials[1:]], values)
            for known in (0.0, 1.0)
        ]
        p = tested.probability
        wanted = least_cost(trials, values) - (cost + (1 - p) * told[0] + p * told[1])
        found = worth_of_test(trials, tested, values, GIVE_UP)
        assert abs(found - wanted) < 1e-9
        signs.add(found > 0)
    assert signs == {True, False}


@pytest.mark.parametrize(
    "change", [{"test": math.inf}, {"probability": 0.0}, {"probability": 1.0}]
)
def test_no_test_is_worth_anything_where_there_is_none_or_nothing_to_find_out(change):
    trial = Trial(0, 0, 1, probability=0.5, cost=1.0, loss=1.0, test=0.1)
    trial = trial._replace(**change)
    assert worth_of_test([trial], trial, {1: 0.0}, GIVE_UP) == -math.inf
