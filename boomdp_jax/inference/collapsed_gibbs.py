"""Kinds of objects one by one, the kinds' own numbers integrated out.

Given all others an object is of a kind in proportion to how many are, or of a new one
in proportion to the concentration, times what the kind's other objects predict of it
(Neal (2000), algorithm 3). The means, structure and label probabilities of the kinds
are integrated out; spreads are kept, and drawn given the objects. A new kind's spreads
come from their prior, which is also what a lone object leaves them. Costs a batch of
likelihoods, one of each chain, for each object. Prefer it to `stick_breaking` where
objects say much: a new kind fits its first object.
"""

import numpy as np

from boomdp_jax.inference.concentration import draw_concentration
from boomdp_jax.inference.kind_shift import shift_kinds
from boomdp_jax.inference.kind_state import (
    KindData,
    KindState,
    Tallies,
    add_object,
    compact,
    log_label,
    log_structure,
)
from boomdp_jax.inference.kind_structures import restructure_kinds
from boomdp_jax.inference.object_moves import Kinds, ObjectMove, draw_index

# A nudge every so often, and how far it goes.
_NUDGE_EVERY, _NUDGE_SHARE = 3, 0.4
# Sweeps between proposals of new structures for a whole kind: they cost as much as the
# rest of a sweep.
_RESTRUCTURE_EVERY = 3
# Common shifts of all objects of a kind in each sweep.
_NUM_SHIFTS = 2


def sweep_collapsed(
    rng: np.random.Generator,
    data: KindData,
    state: KindState,
    number: int,
    *,
    fixed_concentration: bool = False,
) -> tuple[KindState, np.ndarray]:
    """Draw every object's kind, structure and coordinates once, and the rest.

    Args:
        rng: source of randomness.
        data: what is known of the objects.
        state: of all chains.
        number: of the sweep; every few sweeps coordinates move a little instead.
        fixed_concentration: whether to leave the concentration as it is.

    Returns:
        The new state, and the share of chains that accepted, `[N]`.
    """
    state = compact(rng, data, state)
    for _ in range(_NUM_SHIFTS):
        state = shift_kinds(rng, data, state)
    draw_spreads(rng, data, state)
    if number % _RESTRUCTURE_EVERY == 0:
        restructure_kinds(rng, data, state)
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
    tallies, model = state.tallies, data.coordinates
    log_weight = model.log_marginal(tallies.num, tallies.first, tallies.second)
    state.spread[:] = draw_index(rng, log_weight + model.log_weight)


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

    def log_exact(kind: np.ndarray, z: np.ndarray) -> np.ndarray:
        of_kind = (x[chains, kind] for x in sums)
        return part.log_predictive(z, *of_kind, spread[chains, kind])

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
        choice, before = move.draw(rng), move.log_ratio(*old)
    return decide(rng, data, state, i, choice, before)


def decide(rng, data: KindData, state: KindState, i: int, choice, before) -> float:
    """Accept or refuse proposals of an object in all chains; the share accepted."""
    chains = np.arange(len(choice.kind))
    new = data.log_likelihood(np.full(len(chains), i), choice.structure, choice.z)
    log_odds = new + choice.log_ratio - state.log_likelihood[:, i] - before
    is_taken = choice.is_inside & np.isfinite(new)
    is_taken &= np.log(1.0 - rng.random(len(chains))) < np.nan_to_num(
        log_odds, nan=-np.inf
    )
    state.kind[is_taken, i] = choice.kind[is_taken]
    state.structure[is_taken, i] = choice.structure[is_taken]
    state.z[is_taken, i] = choice.z[is_taken]
    state.log_likelihood[is_taken, i] = new[is_taken]
    return float(is_taken.mean())


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
