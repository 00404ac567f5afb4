"""Kinds of objects one by one, the kinds' own numbers integrated out.

Given all others an object is of a kind in proportion to how many are, or of a new one
in proportion to the concentration, times what the kind's other objects predict of it
(Neal (2000), algorithm 3). The means, structure and label probabilities of the kinds
are integrated out; spreads are kept, and drawn given the objects. A new kind's spreads
come from their prior, which is also what a lone object leaves them. Costs a batch of
some hundred likelihoods for each object, and a few for whole kinds. Prefer it to
`stick_breaking` where objects say much: a new kind fits its first object.
"""

import functools

import numpy as np

from boomdp_jax.inference.kinds.concentration import draw_concentration
from boomdp_jax.inference.kinds.object_moves import Kinds, ObjectMove, draw_index
from boomdp_jax.inference.kinds.particles import (
    draw_spreads_given,
    regather_kinds,
    split_or_merge_kinds,
)
from boomdp_jax.inference.kinds.shift import shift_kinds
from boomdp_jax.inference.kinds.state import (
    KindData,
    KindState,
    Tallies,
    add_object,
    compact,
    log_label,
    log_structure,
)

# A nudge every so often, and how far it goes.
_NUDGE_EVERY, _NUDGE_SHARE = 3, 0.4
# Sweeps between draws of whole kinds afresh, which cost as much as the rest of one.
_REGATHER_EVERY = 3
# Of each kind, or pair of kinds, that is drawn afresh.
_NUM_PARTICLES = 16
# Likelihoods of one object that are worked out at once: fewer hardly take less time.
_NUM_POINTS = 512
# Common shifts of all objects of a kind in each sweep.
_NUM_SHIFTS = 6


def sweep_collapsed(
    rng: np.random.Generator,
    data: KindData,
    state: KindState,
    number: int,
    log_pair: np.ndarray,
    *,
    fixed_concentration: bool = False,
) -> tuple[KindState, np.ndarray]:
    """Draw every object's kind, structure and coordinates once, and the rest.

    Args:
        rng: source of randomness.
        data: what is known of the objects.
        state: of all chains.
        number: of the sweep; every few sweeps coordinates move a little instead.
        log_pair: `kind_pairs.log_pairs` of the objects.
        fixed_concentration: whether to leave the concentration as it is.

    Returns:
        The new state, and the share of chains that accepted, `[N]`.
    """
    state = compact(rng, data, state)
    for _ in range(_NUM_SHIFTS):
        state = shift_kinds(rng, data, state)
    split_or_merge_kinds(rng, data, state, _NUM_PARTICLES, log_pair)
    if number % _REGATHER_EVERY == 0:
        regather_kinds(rng, data, state, _NUM_PARTICLES)
    # Not before: the spreads are integrated out of all these.
    draw_spreads(rng, data, state)
    accepted = np.ones(data.num_objects)
    is_nudge = number % _NUDGE_EVERY == _NUDGE_EVERY - 1
    for i in rng.permutation(data.num_objects).tolist():
        state = _with_room(rng, data, state)
        add_object(data, state, i, -1.0)
        new_slot = _new_slot(state, i)
        accepted[i] = _move(rng, data, state, i, new_slot, is_nudge)
        add_object(data, state, i, 1.0)
    if not fixed_concentration:
        count = state.tallies.count
        state.concentration[:] = draw_concentration(
            rng,
            state.concentration,
            np.sum(count > 0, axis=1),
            count.sum(axis=1),
            data.prior.concentration_shape,
            data.prior.concentration_rate,
        )
    return state, accepted


def draw_spreads(rng: np.random.Generator, data: KindData, state: KindState) -> None:
    """Spreads of all kinds given their objects; of empty ones from the prior."""
    tallies = state.tallies
    sums = (tallies.num, tallies.first, tallies.second)
    state.spread[:] = draw_spreads_given(rng, data.coordinates, sums)


def _with_room(rng: np.random.Generator, data: KindData, state: KindState) -> KindState:
    """Make sure that every chain has an empty kind."""
    num_before = state.before.num_slots
    if np.all(np.any(state.tallies.count[:, num_before:] == 0, axis=1)):
        return state
    return compact(rng, data, state)


def _new_slot(state: KindState, i: int) -> np.ndarray:
    """Where a new kind would go: to the one just left, if it is empty now."""
    num_before = state.before.num_slots
    is_empty = state.tallies.count == 0
    is_empty[:, :num_before] = False
    chains = np.arange(len(is_empty))
    is_own = is_empty[chains, state.kind[:, i]]
    return np.where(is_own, state.kind[:, i], np.argmax(is_empty, axis=1))


def _move(rng, data: KindData, state: KindState, i, new_slot, is_nudge) -> float:
    """Propose and decide; the object is not in the tallies."""
    chains = np.arange(len(new_slot))
    model, tallies, dim = data.coordinates, state.tallies, data.dim
    state.spread[chains, new_slot] = model.draw_spread(rng, (len(chains),))
    with np.errstate(divide="ignore"):
        log_weight = np.log(tallies.count)
        log_weight[chains, new_slot] = np.log(state.concentration)
    log_weight = log_weight + log_label(data, tallies, i)
    if data.feature.shape[1]:
        shape = tallies.num[..., dim:].shape
        value = np.broadcast_to(data.feature[i], shape)
        part = model.part(dim, model.dim)
        sums = (x[..., dim:] for x in (tallies.num, tallies.first, tallies.second))
        log_weight = log_weight + part.log_predictive(
            value, *sums, state.spread[..., dim:]
        ).sum(axis=-1)
    bumps = data.bumps[i]
    if bumps is None:
        state.kind[:, i] = draw_index(rng, log_weight)
        return 1.0
    part = model.part(0, dim)
    sums = [x[..., :dim] for x in (tallies.num, tallies.first, tallies.second)]
    spread = state.spread[..., :dim]
    mean, variance = part.predictive(*sums, spread)
    log_exact = functools.partial(part.log_given_sums, sums, spread)
    kinds = Kinds(
        log_weight, log_structure(data, tallies.structure), mean, variance, log_exact
    )
    move = ObjectMove(bumps, data.in_use, part.period, kinds)
    own = np.where(
        tallies.count[chains, state.kind[:, i]] > 0, state.kind[:, i], new_slot
    )
    old = (own, state.structure[:, i], state.z[:, i])
    if is_nudge:
        choice, before = move.nudge(rng, *old, _NUDGE_SHARE)
    else:
        choice = move.draw(rng, num_tries(len(chains)))
        before = move.log_ratio(chains, *old)
    return decide(rng, data, state, i, choice, before)


def num_tries(num_chains: int) -> int:
    """Proposals of each chain that cost about as much as one."""
    return max(1, _NUM_POINTS // num_chains)


def decide(rng, data: KindData, state: KindState, i: int, choice, before) -> float:
    """Take one of several proposals of an object, or keep what each chain has.

    With several each is taken in proportion to target over proposal, and so is the old
    one (Tjelmeland (2004), Using all Metropolis-Hastings proposals to estimate mean
    values, section 3): they must not depend on where the chain is. A single one is
    accepted or refused.

    Args:
        rng: source of randomness.
        data: what is known of the objects.
        state: of all chains, changed in place.
        i: the object.
        choice: the same number of proposals of each chain.
        before: the old points' log of target over proposal, without the likelihood.

    Returns:
        The share of chains in which something was taken.
    """
    num_chains = len(before)
    index = np.full(len(choice.kind), i)
    new = data.log_likelihood(index, choice.structure, choice.z)
    weight = np.where(choice.is_inside, new + choice.log_ratio, -np.inf)
    weight = np.nan_to_num(weight, nan=-np.inf, posinf=-np.inf)
    weight = weight.reshape(num_chains, -1)
    old = state.log_likelihood[:, i] + before
    if weight.shape[1] == 1:
        gain = np.minimum(weight[:, 0] - old, 0.0)
        taken = np.where(np.log(1.0 - rng.random(num_chains)) < gain, 0, 1)
    else:
        taken = draw_index(rng, np.append(weight, old[:, None], axis=1))
    chains = np.flatnonzero(taken < weight.shape[1])
    place = chains * weight.shape[1] + taken[chains]
    state.kind[chains, i] = choice.kind[place]
    state.structure[chains, i] = choice.structure[place]
    state.z[chains, i] = choice.z[place]
    state.log_likelihood[chains, i] = new[place]
    return len(chains) / num_chains


def fill_in(
    rng: np.random.Generator, data: KindData, state: KindState
) -> tuple[np.ndarray, np.ndarray]:
    """Structure and coordinates of all objects, those without readings included.

    The latter are drawn one after the other, each given all before, as from an urn.

    Args:
        rng: source of randomness.
        data: what is known of the objects.
        state: of all chains; stays as it is.

    Returns:
        Structures `[chain, N]` and coordinates `[chain, N, dim]`.
    """
    structure, z, dim = state.structure.copy(), state.z.copy(), data.dim
    part = data.coordinates.part(0, dim)
    tallies = Tallies(*(array.copy() for array in state.tallies))
    chains = np.arange(len(structure))
    for i in np.flatnonzero(~data.is_seen):
        kind = state.kind[:, i]
        structure[:, i] = draw_index(
            rng, log_structure(data, tallies.structure)[chains, kind]
        )
        sums = [
            x[chains, kind, :dim] for x in (tallies.num, tallies.first, tallies.second)
        ]
        value = part.draw_predictive(rng, *sums, state.spread[chains, kind, :dim])
        in_use = data.in_use[structure[:, i]]
        z[:, i] = np.where(in_use, value, 0.0)
        tallies.structure[chains, kind, structure[:, i]] += 1.0
        first, second = part.moments(z[:, i])
        for total, more in zip(
            (tallies.num, tallies.first, tallies.second),
            (in_use.astype(float), np.where(in_use, first, 0.0), second * in_use),
            strict=True,
        ):
            total[chains, kind, :dim] += more
    return structure, z
