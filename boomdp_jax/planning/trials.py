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
from collections.abc import Sequence
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

    Args:
        trials: all from that region; of several with one thing the best is taken.
        values: expected cost from each region on; of one that is missing: giving up.
        give_up: cost of not getting there.

    Returns:
        The order, without what is not worth a trial.
    """
    best: dict[int, tuple[float, Trial]] = {}
    for trial in trials:
        index = index_of(trial, values.get(trial.end, give_up))
        if index < best.get(trial.thing, (math.inf, None))[0]:
            best[trial.thing] = index, trial
    # Whoever pays more than giving up costs does not try; the index is what a trial
    # that is repeated with new things until one works costs.
    ranked = sorted(
        (item for item in best.values() if item[0] < give_up), key=lambda item: item[0]
    )
    order = tuple(trial for _, trial in ranked)
    value = give_up
    for trial in reversed(order):
        success = trial.cost + values.get(trial.end, give_up)
        value = trial.probability * success + (1.0 - trial.probability) * (
            trial.loss + value
        )
    return Order(value, order)


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
