"""Which object is of which kind, in many chains at once, and what kinds have seen."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from boomdp_jax.inference.kinds.coordinates import CoordinateModel
from boomdp_jax.inference.kinds.likelihood_bumps import Bumps
from boomdp_jax.inference.kinds.prior import KindPrior


class KindData(NamedTuple):
    """All that is known of a set of objects; `N` objects, `K` structures.

    The coordinates of the model are those of a structure target, `dim` of them, and
    after them the features of the outline.
    """

    coordinates: CoordinateModel
    in_use: np.ndarray
    """Coordinates that a structure uses, `[K, dim]`."""
    log_prior: np.ndarray
    """Of the structures, `[K]`."""
    bumps: tuple[Bumps | None, ...]
    """Of each object; None: no reading tells of it."""
    label: np.ndarray
    """Of each object, `[N]`; -1: none."""
    num_labels: int
    feature: np.ndarray
    """Of each outline, `[N, F]`."""
    log_likelihood: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
    """Of objects, structures and coordinates of a list of points."""
    prior: KindPrior

    @property
    def num_objects(self) -> int:
        """How many objects there are."""
        return len(self.label)

    @property
    def dim(self) -> int:
        """Coordinates of a structure target."""
        return self.in_use.shape[1]

    @property
    def is_seen(self) -> np.ndarray:
        """Which objects a reading tells of, `[N]`."""
        return np.array([bumps is not None for bumps in self.bumps], bool)


class Tallies(NamedTuple):
    """What the objects of each kind add up to, `[chain, kind, ...]`."""

    count: np.ndarray
    structure: np.ndarray
    """Objects of each structure, `[chain, kind, K]`."""
    label: np.ndarray
    """Objects of each label, `[chain, kind, L + 1]`; the last stands for all others."""
    num: np.ndarray
    """Objects that have a coordinate, `[chain, kind, D]`."""
    first: np.ndarray
    second: np.ndarray

    @property
    def num_slots(self) -> int:
        """Kinds that there is room for."""
        return self.count.shape[1]


def no_tallies(data: KindData, num_chains: int, num_slots: int) -> Tallies:
    """Room for kinds that nothing is of."""
    shape = (num_chains, num_slots)
    total = data.coordinates.dim
    return Tallies(
        np.zeros(shape),
        np.zeros((*shape, len(data.log_prior))),
        np.zeros((*shape, data.num_labels + 1)),
        np.zeros((*shape, total)),
        np.zeros((*shape, total)),
        np.zeros((*shape, total)),
    )


class KindState(NamedTuple):
    """State of all chains; leading axis `chain`. Arrays are changed in place.

    Objects that no reading tells of have no structure and no coordinates here: those
    are integrated out, and drawn at the end.
    """

    kind: np.ndarray
    """Slot of each object's kind, `[chain, N]`."""
    structure: np.ndarray
    z: np.ndarray
    log_likelihood: np.ndarray
    """`[chain, N]`, zero of objects that no reading tells of."""
    spread: np.ndarray
    """Index of the spread of every coordinate of every kind, `[chain, kind, D]`."""
    concentration: np.ndarray
    """`[chain]`."""
    tallies: Tallies
    """Of the objects and of those known before."""
    before: Tallies
    """Of objects known before; their kinds have the first slots."""


def row_of(data: KindData, state: KindState, i: int) -> tuple[np.ndarray, ...]:
    """What object i adds to the tallies: num, first and second, `[chain, D]`."""
    num_chains, dim = len(state.kind), data.dim
    feature = np.broadcast_to(data.feature[i], (num_chains, data.feature.shape[1]))
    value = np.concatenate([state.z[:, i], feature], axis=1)
    has = np.ones(value.shape, bool)
    has[:, :dim] = data.is_seen[i] & data.in_use[state.structure[:, i]]
    first, second = data.coordinates.moments(value)
    return has.astype(float), np.where(has, first, 0.0), np.where(has, second, 0.0)


def add_object(data: KindData, state: KindState, i: int, sign: float) -> None:
    """Put object i into its kind's tallies, or take it out."""
    chains = np.arange(len(state.kind))
    kind, tallies = state.kind[:, i], state.tallies
    tallies.count[chains, kind] += sign
    if data.is_seen[i]:
        tallies.structure[chains, kind, state.structure[:, i]] += sign
    if data.label[i] >= 0:
        tallies.label[chains, kind, data.label[i]] += sign
    num, first, second = row_of(data, state, i)
    tallies.num[chains, kind] += sign * num
    tallies.first[chains, kind] += sign * first
    tallies.second[chains, kind] += sign * second


def compact(rng: np.random.Generator, data: KindData, state: KindState) -> KindState:
    """Move empty kinds to the end, leave room for three, and tally afresh.

    Kinds that were known before keep their places.
    """
    num_before = state.before.num_slots
    is_taken = state.tallies.count > 0
    is_taken[:, :num_before] = True
    order = np.argsort(~is_taken, axis=1, kind="stable")
    place = np.argsort(order, axis=1, kind="stable")
    num_slots = int(is_taken.sum(axis=1).max()) + 3
    num_chains = len(state.kind)
    spread = np.take_along_axis(state.spread, order[..., None], axis=1)
    if spread.shape[1] < num_slots:
        room = num_slots - spread.shape[1]
        new = data.coordinates.draw_spread(rng, (num_chains, room))
        spread = np.concatenate([spread, new], axis=1)
    moved = state._replace(
        kind=np.take_along_axis(place, state.kind, axis=1),
        spread=spread[:, :num_slots].copy(),
        tallies=no_tallies(data, num_chains, num_slots),
    )
    for whole, known in zip(moved.tallies, state.before, strict=True):
        whole[:, :num_before] = known
    for i in range(data.num_objects):
        add_object(data, moved, i, 1.0)
    return moved


def log_label(data: KindData, tallies: Tallies, i: int) -> np.ndarray:
    """Log-probability of object i's label in each kind, `[chain, kind]`."""
    if data.label[i] < 0:
        return np.zeros_like(tallies.count)
    base = label_base(data)
    with_label = tallies.label[..., data.label[i]] + base[data.label[i]]
    return np.log(with_label / (tallies.label.sum(-1) + base.sum()))


def label_base(data: KindData) -> np.ndarray:
    """Pseudo-counts of labels in each kind, `[L + 1]`."""
    weight, num = data.prior.label_weight, data.num_labels
    each = weight / max(data.prior.vocabulary, num + 1)
    return np.append(np.full(num, each), weight - num * each)


def log_structure(data: KindData, count: np.ndarray) -> np.ndarray:
    """Log-probability of each structure in kinds that have so many, `[..., K]`."""
    weight = data.prior.structure_weight
    share = count + weight * np.exp(data.log_prior)
    total = count.sum(-1, keepdims=True) + weight
    with np.errstate(divide="ignore"):
        return np.log(share / total)


def log_joint(data: KindData, state: KindState) -> np.ndarray:
    """Log-density of kinds, structures and coordinates, likelihood included, `[chain]`.

    Means, spreads, shares and probabilities of the kinds are integrated out; given the
    concentration.
    """
    tallies, before = state.tallies, state.before
    num_before = before.num_slots
    prior = data.prior
    alpha = state.concentration
    out = state.log_likelihood.sum(axis=1)
    out = out + _log_partition(tallies.count, before.count, alpha)
    base = prior.structure_weight * np.exp(data.log_prior)
    out += _log_dirichlet(tallies.structure, before.structure, base)
    out += _log_dirichlet(tallies.label, before.label, label_base(data))
    each = log_coordinates(data, tallies)
    each[:, :num_before] -= log_coordinates(data, before)
    return out + each.sum(axis=1)


def log_coordinates(data: KindData, tallies: Tallies) -> np.ndarray:
    """Log-density of each kind's coordinates, spreads too integrated out.

    Args:
        data: what is known of the objects.
        tallies: of the kinds.

    Returns:
        One number for each, `[chain, kind]`.
    """
    sums = (tallies.num, tallies.first, tallies.second)
    return data.coordinates.log_over_spreads(*sums).sum(axis=-1)


def _lgamma(x: np.ndarray) -> np.ndarray:
    """Logarithm of the gamma function of positive numbers, by Stirling's series."""
    x = np.asarray(x, float)
    # Eight steps up, where the series is good to rounding.
    steps = np.log(x[..., None] + np.arange(8.0)).sum(axis=-1)
    y = x + 8.0
    series = 1 / (12 * y) - 1 / (360 * y**3) + 1 / (1260 * y**5) - 1 / (1680 * y**7)
    return (y - 0.5) * np.log(y) - y + 0.5 * np.log(2 * np.pi) + series - steps


def _log_partition(count, before, alpha) -> np.ndarray:
    """Chinese-restaurant probability of the objects' kinds, given those before."""
    num_before = before.shape[1]
    is_new = count[:, num_before:] > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        new = np.where(is_new, np.log(alpha)[:, None], 0.0)
    new = new + np.where(is_new, _lgamma(np.maximum(count[:, num_before:], 1)), 0.0)
    old = _lgamma(np.maximum(count[:, :num_before], 1e-9)) - _lgamma(
        np.maximum(before, 1e-9)
    )
    first, last = alpha + before.sum(1), alpha + count.sum(1)
    return new.sum(1) + old.sum(1) + _lgamma(first) - _lgamma(last)


def _log_dirichlet(count, before, base) -> np.ndarray:
    """Probability of counts given those before, each kind a Dirichlet of its own."""
    possible = base > 0
    count, base = count[..., possible], base[possible]
    earlier = np.zeros_like(count)
    earlier[:, : before.shape[1]] = before[..., possible]
    each = _lgamma(base + count) - _lgamma(base + earlier)
    total = _lgamma(base.sum() + earlier.sum(-1)) - _lgamma(base.sum() + count.sum(-1))
    return each.sum(axis=(1, 2)) + total.sum(axis=1)
