"""Resampling on the way from fixed gains to noise of their own (`correction`).

The first step is the hardest: coordinates and noise were drawn on their own, and of an
object whose posterior bends few pairs may be any good. Where that is so each draw is
given more noises, of proposals fitted to what weights have shown (`rounds`), as
long as that changes for how many draws count, their weights summed over noises; and the
first resampling chooses among all: moves could part the copies of a few later only
slowly. (That their number depends on the weights makes the evidence a little too small,
by less the more draws there are: about one per cent with a thousand.)
"""

from typing import NamedTuple

import numpy as np

from boomdp_jax.inference.noise.problem import (
    NoiseDraws,
    NoiseProblem,
    effective_size,
)
from boomdp_jax.inference.samplers.resampling import systematic
from boomdp_jax.inference.samplers.tempered_smc import next_step, times

# Share of the draws that weights of a step count for.
_KEPT_SHARE = 0.5
# Draws are given more noises until the first weights count for this share of them, as
# long as that changes for how many they count by such a factor (for fewer, where what
# was missed has only now been found), at most so many each.
_ENOUGH_SHARE, _GROWTH, _MOST_NOISES = 0.25, 1.1, 8


class Resampled(NamedTuple):
    """What a step does."""

    draws: NoiseDraws
    """As many as before, of equal weight; those of objects that have arrived stay."""
    step: np.ndarray
    """By how much the power grew, `[object]`."""
    log_mean: np.ndarray
    """Of the weights of each chain, `[object, chain]`; zero where nothing was done."""


def first_step(
    rng: np.random.Generator,
    problem: NoiseProblem,
    draws: NoiseDraws,
    index: np.ndarray,
    num_chains: int,
) -> tuple[Resampled, np.ndarray, NoiseProblem]:
    """Resample for the first time, giving draws more noises where few are any good.

    Args:
        rng: source of randomness.
        problem: of the draws.
        draws: the list, each with one noise.
        index: object of each draw, as many of each.
        num_chains: of each object, one after the other in the list.

    Returns:
        What was done; draws that weights to the last density count for, `[object]`, of
        draws with several noises their sums; and the problem with the proposals of all.
    """
    num_objects = int(index[-1]) + 1
    num_draws = len(index) // num_objects
    # Of each object its draws with every noise.
    pools = [[draws.take(index == i)] for i in range(num_objects)]
    size = np.array([_size(pool) for pool in pools])
    is_open = np.ones(num_objects, bool)
    for _ in range(1, _MOST_NOISES):
        asked = np.flatnonzero(is_open & (size < _ENOUGH_SHARE * num_draws))
        if not asked.size:
            break
        rows = np.flatnonzero(np.isin(index, asked))
        latest = problem.with_further_round(
            rng, _joined([part for i in asked for part in pools[i]])
        )
        for i in asked:
            pools[i] = [latest.of_rounds(part, problem) for part in pools[i]]
        problem = latest
        firsts = _joined([pools[i][0] for i in asked])
        more = problem.only(rows).with_other_noise(rng, firsts)
        for i in asked:
            pools[i].append(more.take(index[rows] == i))
            before, size[i] = size[i], _size(pools[i])
            is_open[i] = not before / _GROWTH < size[i] < _GROWTH * before
    chosen, steps, log_means = [], [], []
    for pool in pools:
        # Noises of a draw lie side by side, so that it is chosen as often as it should.
        ratio = np.stack([part.ratio for part in pool], axis=1)
        # By draws: pairs count for at least as many.
        step = next_step(ratio, 1.0, _KEPT_SHARE)
        num_each = num_draws // num_chains
        log_weight = times(step, ratio).reshape(num_chains, -1)
        places = _places(rng, log_weight, num_each)
        place, noise = np.divmod(places, len(pool))
        place = place + num_each * np.arange(num_chains)[:, None]
        chosen.append(_joined(pool).take((num_draws * noise + place).ravel()))
        steps.append(step)
        log_means.append(_log_mean(log_weight))
    found = Resampled(_joined(chosen), np.array(steps), np.array(log_means))
    return found, size, problem


def further_step(
    rng: np.random.Generator, draws: NoiseDraws, power: np.ndarray, num_chains: int
) -> Resampled:
    """Resample the draws of objects that are on their way.

    Args:
        rng: source of randomness.
        draws: the list.
        power: how far from the first density to the last, `[object]`.
        num_chains: of each object.
    """
    ratio = draws.ratio.reshape(len(power), num_chains, -1)
    num_each = ratio.shape[-1]
    steps, log_mean = np.zeros(len(power)), np.zeros(ratio.shape[:2])
    rows = np.arange(ratio.size).reshape(ratio.shape)
    for i in np.flatnonzero(power < 1.0):
        steps[i] = next_step(ratio[i].ravel(), 1.0 - power[i], _KEPT_SHARE)
        log_weight = times(steps[i], ratio[i])
        log_mean[i] = _log_mean(log_weight)
        places = _places(rng, log_weight, num_each)
        rows[i] = np.take_along_axis(rows[i], places, axis=1)
    return Resampled(draws.take(rows.ravel()), steps, log_mean)


def _joined(parts: list[NoiseDraws]) -> NoiseDraws:
    """One list after the other."""
    return NoiseDraws(*map(np.concatenate, zip(*parts, strict=True)))


def _size(pool: list[NoiseDraws]) -> float:
    """Draws that count, with the weights of their noises added up."""
    return effective_size(np.logaddexp.reduce([part.ratio for part in pool], axis=0))


def _log_mean(log_weight: np.ndarray) -> np.ndarray:
    """Of the weights of each chain, `[chain]`."""
    return np.logaddexp.reduce(log_weight, axis=-1) - np.log(log_weight.shape[-1])


def _places(rng: np.random.Generator, log_weight: np.ndarray, num: int) -> np.ndarray:
    """So many places for each chain, in random order, `[chain, place]`."""
    top = log_weight.max(axis=-1, keepdims=True)
    is_lost = ~np.isfinite(top)
    weight = np.where(is_lost, 1.0, np.exp(log_weight - np.where(is_lost, 0.0, top)))
    return np.stack([rng.permutation(systematic(rng, w, num)) for w in weight])
