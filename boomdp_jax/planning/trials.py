r"""In what order to try things that may or may not work, and what that costs.

From a region several things may be moved, each of which opens the way to another region
with some probability; whether it does is a fact that a trial finds out. With s the cost
of thing i's success, what follows included, and t that of its failure, thing i before j
is cheaper than j before i exactly if

$$s_i + t_i \frac{1 - p_i}{p_i} < s_j + t_j \frac{1 - p_j}{p_j},$$

whatever comes after (Simon and Kadane 1975, Optimal problem-solving search: all-or-none
solutions, by the same exchange of neighbours). So values of regions are had by sorting:
work is linear in the number of things but for that.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple


class Trial(NamedTuple):
    """A thing that may be moved, so that one region joins another."""

    thing: int
    start: int
    """Region in which the robot is."""
    end: int
    """Region that it can get to then."""
    probability: float
    """That the thing can be moved so."""
    cost: float
    """If it can."""
    loss: float
    """Until it is known that it cannot."""
    test: float = math.inf
    """Of finding out, and nothing else; infinite: there is no cheaper way than to
    try."""
    tag: object = None
    """What the caller knows it by."""


class Order(NamedTuple):
    """What is best to do from a region."""

    value: float
    """Expected cost of getting to the goal, or of giving up."""
    trials: tuple[Trial, ...]
    """In the order in which they are tried, one a thing."""


class _Ranked(NamedTuple):
    """A trial with what it leads to."""

    index: float
    success: float
    """Cost, what follows included."""
    trial: Trial


def index_of(trial: Trial, value_after: float) -> float:
    """By which trials are sorted; infinite for what cannot work."""
    if trial.probability <= 0.0:
        return math.inf
    odds = (1.0 - trial.probability) / trial.probability
    return trial.cost + value_after + trial.loss * odds


def best_order(
    trials: Sequence[Trial], values: dict[int, float], give_up: float
) -> Order:
    """The best order in which to try things from one region.

    With one trial a thing no order of any of them is cheaper. A thing with several
    trials is tried in one way only: the likelier one is not always that of the least
    index, so ways are exchanged until no exchange at one thing is cheaper.

    Args:
        trials: all from that region.
        values: expected cost from each region on; of one that is missing: giving up.
        give_up: cost of not getting there.

    Returns:
        The order, without what is not worth a trial.
    """
    ways: dict[int, list[_Ranked]] = {}
    for trial in trials:
        after = values.get(trial.end, give_up)
        index = index_of(trial, after)
        # Before others whose value is V a trial pays if its index is below V, and V is
        # never above that of giving up.
        if index < give_up:
            found = _Ranked(index, trial.cost + after, trial)
            ways.setdefault(trial.thing, []).append(found)
    chosen = {thing: min(own, key=lambda way: way.index) for thing, own in ways.items()}
    value, is_settled = _value(chosen.values(), give_up), False
    while not is_settled:
        is_settled = True
        for thing, own in ways.items():
            for way in own:
                changed = {**chosen, thing: way}
                other = _value(changed.values(), give_up)
                if other < value:
                    chosen, value, is_settled = changed, other, False
    return Order(value, tuple(one.trial for one in _sorted(chosen.values())))


def region_values(
    trials: Sequence[Trial], goal: int, give_up: float
) -> dict[int, float]:
    """Expected cost from every region to the goal's.

    Args:
        trials: of all regions.
        goal: region of the goal, from which nothing costs any more.
        give_up: cost of not getting there.

    Returns:
        Of each region that a trial begins or ends in, and the goal's.
    """
    starts: dict[int, list[Trial]] = {}
    for trial in trials:
        starts.setdefault(trial.start, []).append(trial)
    values = {region: give_up for t in trials for region in (t.start, t.end)}
    values[goal] = 0.0
    # Values only fall, and each sweep is right for one more region on the way.
    for _ in range(len(values)):
        before = dict(values)
        for region, own in starts.items():
            if region != goal:
                values[region] = best_order(own, values, give_up).value
        if values == before:
            break
    return values


def worth_of_test(
    trials: Sequence[Trial], trial: Trial, values: dict[int, float], give_up: float
) -> float:
    """By how much it pays to find out first whether a thing can be moved.

    Args:
        trials: from the region.
        trial: the one that would be tested, and its `test` cost.
        values: of regions.
        give_up: cost of not getting there.

    Returns:
        Expected cost of the best order without the test, less that with it; negative
        where a test does not pay.
    """
    if not math.isfinite(trial.test) or not 0.0 < trial.probability < 1.0:
        return -math.inf

    def known(works: bool) -> float:
        told = [
            t._replace(probability=float(works)) if t.thing == trial.thing else t
            for t in trials
        ]
        return best_order(told, values, give_up).value

    now = best_order(trials, values, give_up).value
    p = trial.probability
    return now - (trial.test + p * known(True) + (1.0 - p) * known(False))


def _sorted(ranked: Iterable[_Ranked]) -> list[_Ranked]:
    return sorted(ranked, key=lambda one: one.index)


def _value(ranked: Iterable[_Ranked], give_up: float) -> float:
    """Expected cost of trying all of them in the best order."""
    value = give_up
    for _, success, trial in reversed(_sorted(ranked)):
        failure = trial.loss + value
        value = trial.probability * success + (1.0 - trial.probability) * failure
    return value
