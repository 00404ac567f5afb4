r"""Structures of all objects of a kind proposed together.

Objects of a kind mostly have one structure. Where the readings leave it open, one of
them rarely takes another while the others keep theirs: each alone would have to be the
exception. Here all objects of one kind in each chain leave it and come back one after
the other, structure and coordinates drawn afresh from their bumps and from those that
came back before, and the lot is accepted or refused by the true likelihoods (after Dahl
(2005), Sequentially-allocated merge-split sampler for conjugate and nonconjugate
Dirichlet process mixture models; here the members stay). With the normaliser Z_i of
each draw, which depends on the draws before it, the target over the proposal is the
product of $L_i Z_i\, p_i / q_i$, with p and q as in `object_moves`; the way back is the
old values in the same order.
"""

from typing import NamedTuple

import numpy as np

from boomdp_jax.inference.kind_state import KindData, KindState, log_structure
from boomdp_jax.inference.object_moves import Choice, Kinds, ObjectMove


class _Sums(NamedTuple):
    """Of one kind in each chain, leading axis `chain`; changed in place."""

    structure: np.ndarray
    num: np.ndarray
    first: np.ndarray
    second: np.ndarray

    def copy(self) -> "_Sums":
        return _Sums(*(array.copy() for array in self))


def restructure_kinds(
    rng: np.random.Generator, data: KindData, state: KindState
) -> None:
    """Propose new structures and coordinates for one kind of every chain.

    Args:
        rng: source of randomness.
        data: what is known of the objects.
        state: of all chains, changed in place; spreads are those it has.
    """
    seen = np.flatnonzero(data.is_seen)
    if not len(seen):
        return
    num_chains = len(state.kind)
    chains = np.arange(num_chains)
    kind = state.kind[chains, rng.choice(seen, size=num_chains)]
    order = rng.permutation(seen).tolist()
    is_member = {i: state.kind[:, i] == kind for i in order}
    old = {i: (state.structure[:, i].copy(), state.z[:, i].copy()) for i in order}
    left = _without(data, state, kind, is_member, old)
    spread = state.spread[chains, kind, : data.dim]

    new: dict[int, Choice] = {}
    log_odds, is_inside = np.zeros(num_chains), np.ones(num_chains, bool)
    sums = left.copy()
    for i in order:
        move, mine = _move(data, i, spread, sums), is_member[i]
        new[i] = choice = move.draw(rng)
        log_odds += np.where(mine, choice.log_ratio + move.log_total, 0.0)
        is_inside &= choice.is_inside | ~mine
        _add(data, sums, choice.structure, choice.z, mine, 1.0)
    for i in order:
        move = _move(data, i, spread, left)
        ratio = move.log_ratio(np.zeros(num_chains, int), *old[i])
        log_odds -= np.where(is_member[i], ratio + move.log_total, 0.0)
        _add(data, left, *old[i], is_member[i], 1.0)

    found = {i: (new[i].structure[m], new[i].z[m]) for i, m in is_member.items()}
    structure, z = map(np.concatenate, zip(*found.values(), strict=True))
    num_each = [len(part) for part, _ in found.values()]
    values = data.log_likelihood(np.repeat(order, num_each), structure, z)
    likelihood = {}
    for i, part in zip(order, np.split(values, np.cumsum(num_each)[:-1]), strict=True):
        likelihood[i] = state.log_likelihood[:, i].copy()
        likelihood[i][is_member[i]] = part
        log_odds += likelihood[i] - state.log_likelihood[:, i]
    level = np.log(1.0 - rng.random(num_chains))
    is_taken = is_inside & (level < np.nan_to_num(log_odds, nan=-np.inf))
    for i in order:
        taken = is_taken & is_member[i]
        state.structure[taken, i] = new[i].structure[taken]
        state.z[taken, i] = new[i].z[taken]
        state.log_likelihood[taken, i] = likelihood[i][taken]
    _store(data, state, kind, is_taken, sums)


def _without(data, state: KindState, kind, is_member, old) -> _Sums:
    """What a kind adds up to without the members that are seen."""
    chains, tallies, dim = np.arange(len(kind)), state.tallies, data.dim
    sums = _Sums(
        tallies.structure[chains, kind].copy(),
        *(x[chains, kind, :dim].copy() for x in tallies[3:]),
    )
    for i, mine in is_member.items():
        _add(data, sums, *old[i], mine, -1.0)
    return sums


def _store(data, state: KindState, kind, is_taken, sums: _Sums) -> None:
    chains, tallies, dim = np.flatnonzero(is_taken), state.tallies, data.dim
    own = kind[is_taken]
    tallies.structure[chains, own] = sums.structure[is_taken]
    for whole, part in zip(tallies[3:], sums[1:], strict=True):
        whole[chains, own, :dim] = part[is_taken]


def _add(data, sums: _Sums, structure, z, mine, sign: float) -> None:
    """Put an object into the sums of those chains where it is of the kind."""
    rows = np.flatnonzero(mine)
    sums.structure[rows, structure[rows]] += sign
    first, second = data.coordinates.part(0, data.dim).moments(z)
    has = data.in_use[structure] & mine[:, None]
    sums.num[...] += sign * has
    sums.first[...] += sign * np.where(has, first, 0.0)
    sums.second[...] += sign * np.where(has, second, 0.0)


def _move(data: KindData, i: int, spread: np.ndarray, sums: _Sums) -> ObjectMove:
    """Proposal of object i by what the sums have; to be used before they change."""
    part, tallied = data.coordinates.part(0, data.dim), sums[1:]
    mean, variance = part.predictive(*tallied, spread)

    def log_exact(_: np.ndarray, z: np.ndarray) -> np.ndarray:
        return part.log_predictive(z, *tallied, spread)

    bumps = data.bumps[i]
    assert bumps is not None
    kinds = Kinds(
        np.zeros((len(mean), 1)),
        log_structure(data, sums.structure)[:, None],
        mean[:, None],
        variance[:, None],
        log_exact,
    )
    return ObjectMove(bumps, data.in_use, part.period, kinds)
