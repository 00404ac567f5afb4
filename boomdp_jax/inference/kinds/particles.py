r"""Whole kinds drawn afresh, split in two or made one, by particles.

Objects of a kind hold each other: known tightly from the others, none of them goes far
alone, and two kinds that should be one do not come together object by object. Here all
objects of one kind, or of two, leave and come back one after the other in each of
several particles, their coordinates drawn from their bumps and from those that came
back before; particles are weighed by true likelihoods and resampled; one of them is
what the chain had, so that choosing one by weight leaves the posterior unchanged
(particle Gibbs: Andrieu, Doucet and Holenstein (2010), Particle Markov chain Monte
Carlo methods; to split and merge: Bouchard-Côté, Doucet and Roth (2017), Particle Gibbs
split-merge sampling for Bayesian inference in mixture models).

Which of two kinds objects go to is decided as there: of two anchors the first opens one
kind; the second joins it, and then all others must, or it opens the other, and then
each other object goes to either. Spreads are drawn along the way: given the objects
before it a kind's spreads are auxiliary to the next object, which then has, the spreads
integrated out, its exact conditional density.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from boomdp_jax.inference.kinds.coordinates import CoordinateModel
from boomdp_jax.inference.kinds.object_moves import Kinds, ObjectMove, draw_index
from boomdp_jax.inference.kinds.state import (
    KindData,
    KindState,
    Tallies,
    add_object,
    log_label,
    log_structure,
)

_FIRST, _SECOND = 0, 1
# Effective share of particles under which they are resampled.
_LEAST_SHARE = 0.5


class Particles(NamedTuple):
    """Leading axes `row, particle`; the first particle is what the chain has.

    A row is one kind of a chain, or two; those of one chain have no object in common.
    """

    log_weight: np.ndarray
    side: np.ndarray
    """Which of two kinds the object of each step is of, `[..., step]`."""
    structure: np.ndarray
    z: np.ndarray
    log_likelihood: np.ndarray
    is_split: np.ndarray
    """Whether the anchors are of two kinds."""
    tallies: Tallies
    """Of the two kinds."""

    def take(self, row: np.ndarray, particle: np.ndarray) -> "Particles":
        """Those of some rows, by index."""
        return jax.tree.map(lambda field: field[row, particle], self)


class _Rows(NamedTuple):
    """What leaves and comes back; leading axis `row`."""

    chain: np.ndarray
    kinds: np.ndarray
    """Slots of the two kinds, `[row, 2]`; twice the same where there is one."""
    is_member: np.ndarray
    """Objects that leave, `[row, N]`."""
    order: np.ndarray
    """In which they come back, then -1, `[row, step]`."""
    is_open: bool
    """Whether objects may change sides."""


def regather_kinds(
    rng: np.random.Generator, data: KindData, state: KindState, num_particles: int
) -> float:
    """Draw structures and coordinates afresh, kind by kind.

    Args:
        rng: source of randomness.
        data: what is known of the objects.
        state: of all chains, changed in place but for the spreads, which are
            integrated out and must be drawn afresh afterwards.
        num_particles: of each kind of each chain, two or more.

    Returns:
        The share of kinds that took other particles than their own.
    """
    num_slots = state.tallies.num_slots
    mine = state.kind[:, None, :] == np.arange(num_slots)[:, None]
    mine &= data.is_seen
    chain, slot = np.nonzero(mine.any(axis=2))
    if not len(chain):
        return 0.0
    is_member = mine[chain, slot]
    order = _order(rng, is_member, np.zeros((len(chain), 0), int))
    kinds = np.stack([slot, slot], axis=1)
    rows = _Rows(chain, kinds, is_member, order, False)
    return _run(rng, data, state, rows, num_particles)


def split_or_merge_kinds(
    rng: np.random.Generator,
    data: KindData,
    state: KindState,
    num_particles: int,
    log_pair: np.ndarray,
) -> float:
    """Split one kind of every chain in two, or make two one.

    Kinds that were known before are left as they are, and so are chains without an
    empty kind.

    Args:
        rng: source of randomness.
        data: what is known of the objects.
        state: of all chains, changed in place but for the spreads, as above.
        num_particles: of each chain, two or more.
        log_pair: how often the second anchor is another object, given the first: logs,
            `[N, N]`; must not depend on where the chains are.

    Returns:
        The share of rows that took other particles than their own.
    """
    if data.num_objects < 2 or not data.is_seen.any():
        return 0.0
    num_chains, num_before = len(state.kind), state.before.num_slots
    first = rng.integers(data.num_objects, size=num_chains)
    anchors = np.stack([first, draw_index(rng, log_pair[first])], axis=1)
    kinds = np.take_along_axis(state.kind, anchors, axis=1)
    is_empty = state.tallies.count == 0
    is_empty[:, :num_before] = False
    is_one = kinds[:, 0] == kinds[:, 1]
    kinds[is_one, 1] = np.argmax(is_empty[is_one], axis=1)
    is_able = is_empty.any(axis=1) & np.all(kinds >= num_before, axis=1)
    chain = np.flatnonzero(is_able)
    if not len(chain):
        return 0.0
    kinds = kinds[chain]
    is_member = np.any(state.kind[chain][:, :, None] == kinds[:, None, :], axis=2)
    order = _order(rng, is_member, anchors[chain])
    rows = _Rows(chain, kinds, is_member, order, True)
    return _run(rng, data, state, rows, num_particles)


def _order(rng, is_member: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Members in random order, the given ones first, then -1; `[row, step]`."""
    rank = np.where(is_member, rng.random(is_member.shape), np.inf)
    for place in range(first.shape[1]):
        np.put_along_axis(rank, first[:, place : place + 1], place - 2.0, 1)
    count = is_member.sum(axis=1)
    order = np.argsort(rank, axis=1)[:, : count.max()]
    return np.where(np.arange(order.shape[1]) < count[:, None], order, -1)


def _run(
    rng, data: KindData, state: KindState, rows: _Rows, num_particles: int
) -> float:
    """Particles through all members, and the choice of one."""
    particles = _start(data, state, rows, num_particles)
    for step in range(rows.order.shape[1]):
        if step:
            particles = _resample(rng, particles)
        _propose(rng, data, state, rows, particles, step)
    chosen = draw_index(rng, particles.log_weight)
    best = particles.take(np.arange(len(chosen)), chosen)
    for i in np.flatnonzero(rows.is_member.any(axis=0)).tolist():
        add_object(data, state, i, -1.0)
        taken = np.flatnonzero((chosen > 0) & rows.is_member[:, i])
        chain = rows.chain[taken]
        at = (taken, np.argmax(rows.order[taken] == i, axis=1))
        state.kind[chain, i] = rows.kinds[taken, best.side[at]]
        if data.is_seen[i]:
            state.structure[chain, i] = best.structure[at]
            state.z[chain, i] = best.z[at]
            state.log_likelihood[chain, i] = best.log_likelihood[at]
        add_object(data, state, i, 1.0)
    return float(np.mean(chosen > 0))


def _start(data, state: KindState, rows: _Rows, num_particles: int) -> Particles:
    """All members gone; what a kind had before stays in it."""
    shape = (len(rows.chain), num_particles)
    num_steps, num_before = rows.order.shape[1], state.before.num_slots
    is_known = np.flatnonzero(rows.kinds[:, 0] < num_before)
    tallies = []
    for known in state.before:
        field = np.zeros((*shape, 2, *known.shape[2:]))
        given = known[rows.chain[is_known], rows.kinds[is_known, 0]]
        field[is_known, :, _FIRST] = given[:, None]
        tallies.append(field)
    return Particles(
        np.zeros(shape),
        np.zeros((*shape, num_steps), np.int8),
        np.zeros((*shape, num_steps), int),
        np.zeros((*shape, num_steps, data.dim)),
        np.zeros((*shape, num_steps)),
        np.zeros(shape, bool),
        Tallies(*tallies),
    )


def _propose(
    rng, data: KindData, state: KindState, rows: _Rows, particles: Particles, step: int
) -> None:
    """The next object of each row into all its particles, which change in place."""
    objects = rows.order[:, step]
    parts, points = [], []
    for i in np.unique(objects[objects >= 0]).tolist():
        part = _Part(rng, data, state, rows, particles, i, step)
        parts.append(part)
        if data.is_seen[i]:
            points.append((np.full(len(part.side), i), part.structure, part.z))
    values = np.zeros(0)
    if points:
        values = data.log_likelihood(*map(np.concatenate, zip(*points, strict=True)))
    for part in parts:
        mine = np.zeros(len(part.side))
        if data.is_seen[part.i]:
            mine, values = np.split(values, [len(part.side)])
        part.store(data, particles, mine)


class _Part:
    """One object put into all particles of the rows whose turn it is."""

    def __init__(
        self,
        rng,
        data: KindData,
        state: KindState,
        rows: _Rows,
        particles: Particles,
        i: int,
        step: int,
    ):
        num_particles = particles.log_weight.shape[1]
        mine = np.flatnonzero(rows.order[:, step] == i)
        self.i, self._step, self._rows = i, step, mine
        self._shape = (len(mine), num_particles)
        tallies = Tallies(
            *(x[mine].reshape(-1, *x.shape[2:]) for x in particles.tallies)
        )
        is_own = np.tile(np.arange(num_particles) == 0, len(mine))
        chain = np.repeat(rows.chain[mine], num_particles)
        structure, z = state.structure[chain, i], state.z[chain, i]
        side = np.zeros(len(chain), int)
        if rows.is_open:
            other = np.repeat(rows.kinds[mine, 1], num_particles)
            side = np.where(state.kind[chain, i] == other, _SECOND, _FIRST)
            is_split = particles.is_split[mine].reshape(-1)
            log_alpha = np.log(state.concentration[chain])
            log_weight = _log_sides(data, tallies, i, log_alpha, is_split, step)
        else:
            log_weight = np.where(np.arange(2) == _FIRST, 0.0, -np.inf)
            log_weight = np.broadcast_to(log_weight, (len(chain), 2))
        if not data.is_seen[i]:
            drawn = draw_index(rng, log_weight)
            self.side = np.where(is_own, side, drawn)
            self.structure, self.z = structure, z
            self.log_gain = np.logaddexp(log_weight[:, 0], log_weight[:, 1])
            return
        model, dim = data.coordinates.part(0, data.dim), data.dim
        sums = [x[..., :dim] for x in tallies[3:]]
        spread = draw_spreads_given(rng, model, sums)
        own_points = np.flatnonzero(is_own)
        own_spread = _spreads_with(
            rng, data, model, sums, own_points, side, structure, z
        )
        spread[own_points, side[own_points]] = own_spread
        mean, variance = model.predictive(*sums, spread)
        log_exact = functools.partial(model.log_given_sums, sums, spread)
        bumps = data.bumps[i]
        assert bumps is not None
        log_structures = log_structure(data, tallies.structure)
        kinds = Kinds(log_weight, log_structures, mean, variance, log_exact)
        move = ObjectMove(bumps, data.in_use, model.period, kinds)
        choice = move.draw_or_keep(rng, is_own, side, structure, z)
        self.side, self.structure, self.z = choice.kind, choice.structure, choice.z
        gain = choice.log_ratio + move.log_total
        self.log_gain = np.where(choice.is_inside, gain, -np.inf)

    def store(self, data: KindData, particles: Particles, log_likelihood) -> None:
        """Put the object into the particles, and weigh them."""
        i, step, shape, rows = self.i, self._step, self._shape, self._rows
        cell = np.ix_(rows, np.arange(shape[1]))
        gain = np.nan_to_num(
            self.log_gain + log_likelihood, nan=-np.inf, posinf=-np.inf
        )
        particles.log_weight[rows] += gain.reshape(shape)
        side = self.side.reshape(shape)
        particles.side[rows, :, step] = side
        particles.is_split[rows] |= side == _SECOND
        place = (*cell, side)
        tallies = particles.tallies
        tallies.count[place] += 1.0
        if data.label[i] >= 0:
            tallies.label[(*place, np.full(shape, data.label[i]))] += 1.0
        feature = np.broadcast_to(data.feature[i], (*shape, data.feature.shape[1]))
        z = self.z.reshape(*shape, -1)
        value = np.concatenate([z, feature], axis=-1)
        has = np.ones(value.shape, bool)
        if data.is_seen[i]:
            structure = self.structure.reshape(shape)
            tallies.structure[(*place, structure)] += 1.0
            has[..., : data.dim] = data.in_use[structure]
            particles.structure[rows, :, step] = structure
            particles.z[rows, :, step] = z
            particles.log_likelihood[rows, :, step] = log_likelihood.reshape(shape)
        else:
            has[..., : data.dim] = False
        first, second = data.coordinates.moments(value)
        tallies.num[place] += has
        tallies.first[place] += np.where(has, first, 0.0)
        tallies.second[place] += np.where(has, second, 0.0)


def _log_sides(data, tallies: Tallies, i, log_alpha, is_split, step) -> np.ndarray:
    """What the restaurant, label and outline say of both sides, `[point, 2]`."""
    with np.errstate(divide="ignore"):
        out = np.log(tallies.count)
    out = np.where(tallies.count == 0, log_alpha[:, None], out)
    if step == 0:
        out[:, _SECOND] = -np.inf
    elif step > 1:
        out[~is_split, _SECOND] = -np.inf
    out = out + log_label(data, tallies, i)
    if data.feature.shape[1]:
        dim = data.dim
        part = data.coordinates.part(dim, data.coordinates.dim)
        old = [x[..., dim:] for x in tallies[3:]]
        value = np.broadcast_to(data.feature[i], old[0].shape)
        first, second = part.moments(value)
        new = (old[0] + 1.0, old[1] + first, old[2] + second)
        gain = part.log_over_spreads(*new) - part.log_over_spreads(*old)
        out = out + gain.sum(axis=-1)
    return out


def draw_spreads_given(
    rng: np.random.Generator, model: CoordinateModel, sums: Sequence[np.ndarray]
) -> np.ndarray:
    """Which spread each coordinate has, given the objects of a kind.

    Args:
        rng: source of randomness.
        model: of the coordinates, `D` of them.
        sums: `num`, `first` and `second` of `Tallies`, `[..., D]` each.

    Returns:
        Indices, `[..., D]`.
    """
    return draw_index(rng, model.log_marginal(*sums) + model.log_weight)


def _spreads_with(rng, data, model, sums, points, side, structure, z) -> np.ndarray:
    """Spreads of the chain's own kind, given the next object as well."""
    own = [x[points, side[points]] for x in sums]
    has = data.in_use[structure[points]]
    first, second = model.moments(z[points])
    more = (has.astype(float), np.where(has, first, 0.0), np.where(has, second, 0.0))
    return draw_spreads_given(
        rng, model, [a + b for a, b in zip(own, more, strict=True)]
    )


def _resample(rng, particles: Particles) -> Particles:
    """Where weights have become uneven; the first particle stays."""
    log_weight = particles.log_weight
    num_chains, num_particles = log_weight.shape
    weight = np.exp(log_weight - log_weight.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    is_uneven = np.sum(weight**2, axis=1) * num_particles * _LEAST_SHARE > 1.0
    parent = np.tile(np.arange(num_particles), (num_chains, 1))
    if not is_uneven.any():
        return particles
    rows = np.flatnonzero(is_uneven)
    parent[rows, 1:] = draw_index(rng, log_weight[rows], num_particles - 1)
    taken = particles.take(np.arange(num_chains)[:, None], parent)
    taken.log_weight[rows] = 0.0
    return taken
