r"""Proposals that move every draw of a list by what the others of its group say.

Groups are draws of one structure of one object. Two kinds:

- by the difference of two draws (ter Braak 2006, A Markov chain Monte Carlo version of
  differential evolution), which asks nothing of the shape of a posterior, and gets
  about slowly where there are many numbers;
- about the mean of the group, $x' = m + \sqrt{1 - b^2}\,(x - m) + b L \xi$ with $L L^T$
  its covariance (Neal 1999, Regression and classification using Gaussian process
  priors; Cotter et al. 2013, MCMC methods for functions). It leaves the normal density
  q of that mean and covariance as it is, so that a posterior p is left as it is by
  accepting with $p(x') q(x) / p(x) q(x')$: the nearer to normal a posterior, the
  further one such move goes, in however many dimensions. Mean and covariance are those
  of other draws than the ones that they move, and of none that were copied from the
  same one: a draw that shapes q has too much of it where it stands, and leaves too
  easily. All move at the same time, which leaves each draw its law if they were
  independent, and ties draws that move each other a little.
"""

from typing import NamedTuple

import numpy as np

from boomdp_jax.inference.hypotheses.periods import wrapped

# Draws of a group from which its spread is taken.
_LEAST_GROUP = 4
# Parts of a group, each moved by what the others say, and how many of these there have
# to be for each number.
_NUM_PARTS, _LEAST_FOR_EACH = 4, 5
# Added to the diagonal of correlations.
_RIDGE = 1e-6


class Proposed(NamedTuple):
    """Where draws might go; `[draw, ...]`."""

    values: np.ndarray
    log_ratio: np.ndarray
    """Density of the proposal back over that of the proposal."""


def by_differences(
    rng: np.random.Generator,
    values: np.ndarray,
    group: np.ndarray,
    period: np.ndarray,
    num_moved: np.ndarray,
    size: float,
) -> Proposed:
    """Steps along the difference of two draws of the group, stretched at random.

    Args:
        rng: source of randomness.
        values: where draws are, `[draw, number]`.
        group: of each, `[draw]`.
        period: of each number; zero: it has none.
        num_moved: how many numbers of each draw are free, `[draw]`.
        size: length relative to the best for a normal density.
    """
    order = np.argsort(group, kind="stable")
    num = np.bincount(group)[group]
    begin = np.searchsorted(group[order], group)
    pick = [order[begin + (rng.random(len(num)) * num).astype(int)] for _ in range(2)]
    step = wrapped(values[pick[0]] - values[pick[1]], period)
    length = size * 2.38 / np.sqrt(2.0 * num_moved)[:, None]
    stretch = length * np.exp(rng.standard_normal((len(num), 1)) * 0.5)
    step = np.where((num >= _LEAST_GROUP)[:, None], stretch * step, 0.0)
    return Proposed(wrapped(values + step, period), np.zeros(len(num)))


def about_means(
    rng: np.random.Generator,
    values: np.ndarray,
    group: np.ndarray,
    period: np.ndarray,
    family: np.ndarray | None = None,
) -> Proposed:
    """Moves that would keep the normal density of each group's mean and covariance.

    Draws of small groups stay (`are_enough`). A number with a period is one within half
    of it of its mean: where a move would leave that range it is ruled out.

    Args:
        rng: source of randomness.
        values: where draws are, `[draw, number]`.
        group: of each, `[draw]`.
        period: of each number; zero: it has none.
        family: which draw each was copied from, `[draw]`; None: none was copied.
    """
    out, log_ratio = values.copy(), np.zeros(len(values))
    family = np.arange(len(values)) if family is None else family
    for name in np.flatnonzero(are_enough(values, group)):
        rows = np.flatnonzero(group == name)
        used = _varied(values[rows])
        dealt = _dealt(rng, family[rows])
        for part in range(_NUM_PARTS):
            mine = dealt == part
            own, others = rows[mine], values[rows[~mine]]
            if len(others) < _LEAST_FOR_EACH * used.size or not own.size:
                continue
            moved, gain = _about_mean(
                rng, values[np.ix_(own, used)], others[:, used], period[used]
            )
            out[np.ix_(own, used)] = moved
            log_ratio[own] = gain
    return Proposed(out, log_ratio)


def are_enough(values: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Whether the draws of each group are enough to tell its spread, `[group]`.

    Args:
        values: where draws are, `[draw, number]`.
        group: of each, `[draw]`; groups without any are not enough.
    """
    found = np.zeros(group.max(initial=-1) + 1, bool)
    for name in np.unique(group):
        mine = values[group == name]
        num = len(mine) * (_NUM_PARTS - 1) // _NUM_PARTS
        num_used = _varied(mine).size
        found[name] = num_used > 0 and num >= _LEAST_FOR_EACH * num_used
    return found


def from_means(values: np.ndarray, group: np.ndarray, period: np.ndarray) -> np.ndarray:
    """By how much draws differ from the means of their groups, angles the shorter way.

    Args:
        values: where draws are, `[draw, number]`.
        group: of each, `[draw]`.
        period: of each number; zero: it has none.
    """
    out = np.empty_like(values)
    for name in np.unique(group):
        mine = group == name
        out[mine] = wrapped(values[mine] - _mean(values[mine], period), period)
    return out


def _dealt(rng: np.random.Generator, family: np.ndarray) -> np.ndarray:
    """Part of each draw: parts about equal, copies of one draw in the same."""
    _, family, sizes = np.unique(family, return_inverse=True, return_counts=True)
    part, filled = np.zeros(len(sizes), int), np.zeros(_NUM_PARTS)
    order = rng.permutation(len(sizes))
    # The largest families first, each where there is most room.
    for name in order[np.argsort(-sizes[order], kind="stable")]:
        part[name] = np.argmin(filled)
        filled[part[name]] += sizes[name]
    return part[family]


def walk_share(uniform):
    """What part of a walk is new, mostly close to all.

    Of normal densities fitted to draws, moves that are wholly new go farthest, though
    only one in five may be accepted: of carts seen for fifty steps one with a share of
    0.98 went two and a half times as far, in mean square, as one of the share that has
    two in five accepted. Smaller shares are for draws where such have no chance.

    Args:
        uniform: random numbers in (0, 1).
    """
    return 1.0 - 0.8 * uniform**3


def _about_mean(
    rng: np.random.Generator,
    values: np.ndarray,
    others: np.ndarray,
    period: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Moves of some draws about the mean of others, and their log-ratios."""
    center = _mean(others, period)
    spread = wrapped(others - center, period)
    # Others may all have one value of a number: draws then stay near it.
    sd = np.maximum(np.sqrt(np.mean(spread**2, axis=0)), _rounding(others))
    unit = spread / sd
    correlation = unit.T @ unit / len(others)
    factor = np.linalg.cholesky(correlation + _RIDGE * np.eye(len(sd)))
    offset = wrapped(values - center, period)
    now = np.linalg.solve(factor, (offset / sd).T).T
    share = walk_share(rng.random((len(values), 1)))
    new = np.sqrt(1.0 - share**2) * now + share * rng.standard_normal(now.shape)
    moved = (new @ factor.T) * sd
    half = np.where(period > 0, 0.5 * period, np.inf)
    is_inside = np.all(np.abs(moved) < half, axis=1)
    gain = 0.5 * (np.sum(new**2, axis=1) - np.sum(now**2, axis=1))
    return wrapped(center + moved, period), np.where(is_inside, gain, -np.inf)


def _varied(values: np.ndarray) -> np.ndarray:
    """Numbers in which draws differ by more than rounding."""
    return np.flatnonzero(np.ptp(values, axis=0) > _rounding(values))


def _rounding(values: np.ndarray) -> np.ndarray:
    return 1e-12 * np.maximum(np.abs(values).max(axis=0), 1.0)


def _mean(values: np.ndarray, period: np.ndarray) -> np.ndarray:
    """Of each number; of one with a period, the direction of the mean vector."""
    turn = 2.0 * np.pi / np.where(period > 0, period, 1.0)
    sine, cosine = np.sin(turn * values), np.cos(turn * values)
    angle = np.arctan2(sine.mean(axis=0), cosine.mean(axis=0))
    return np.where(period > 0, angle / turn, values.mean(axis=0))
