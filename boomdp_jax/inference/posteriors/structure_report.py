"""Which structures the draws have, with symmetric and relabelled ones merged.

Two draws have the same structure where the same kinds of constraint act on the same
bodies. Slots are interchangeable, a joint's ends may be swapped, a drawer's axis may be
turned by pi, and a wheel's heading too, or by pi/2 with its two coefficients swapped;
all of these are undone here before anything is averaged. Only constraints whose
existence is inferred count; known ones are part of the scene.
"""

import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from boomdp_jax.inference.posteriors.summary import (
    Scale,
    axial_difference,
    axial_mean,
    summarise,
)
from boomdp_jax.physics.constraint_spec import JOINTS
from boomdp_jax.physics.params import WORLD, Params

SCALES: dict[str, Scale | tuple[Scale, ...]] = {
    "anchor_a": "identity",
    "anchor_b": "identity",
    "length": "log",
    "axis": "axial",
    "angle": "identity",
    "pose": ("identity", "identity", "axial"),
    "viscous": "log",
    "dry": "log",
    "along_axle": "identity",
    "across_axle": "identity",
}
"""Scale on which each number is sampled, and its spread judged."""

_WORDS = {
    "revolute": "pin",
    "distance": "rod",
    "prismatic": "slide",
    "weld": "weld",
    "wheel": "wheel",
    "ground": "friction",
}


class Slots(NamedTuple):
    """So many constraints of one kind on one body, or between two."""

    kind: str
    body_a: int
    body_b: int
    """Partner of a joint, `WORLD` for the world and for what has no partner."""
    count: int


class StructureDraws(NamedTuple):
    """One structure of the whole scene and the draws that have it."""

    slots: tuple[Slots, ...]
    probability: float
    draws: np.ndarray
    """Indices of the draws."""


def group_by_structure(
    params: Params, inferred: Mapping[str, np.ndarray], weights: np.ndarray
) -> list[StructureDraws]:
    """Sort draws by structure, most probable first.

    Args:
        params: draws, NumPy arrays with a leading draw axis.
        inferred: by kind, which slots are inferred rather than known.
        weights: of the draws, sum to one, `[draw]`.

    Returns:
        One entry per structure that a draw has; probabilities sum to one.
    """
    num_bodies = params.density.shape[1]
    codes = []
    joints = [kind for kind in JOINTS if getattr(params, kind) is not None]
    for kind in joints:
        joint = getattr(params, kind)
        end_a, end_b, _ = _ordered_ends(joint)
        code = end_a * (num_bodies + 1) + np.where(end_b == WORLD, num_bodies, end_b)
        code = np.where(joint.active & inferred[kind], code, -1)
        codes.append(np.sort(code, axis=1))
    for kind in ("wheel", "ground"):
        active = getattr(params, kind).active & inferred[kind]
        codes.append(active.sum(axis=2))
    widths = np.cumsum([code.shape[1] for code in codes])[:-1]
    rows, index = np.unique(
        np.concatenate(codes, axis=1).astype(np.int64), axis=0, return_inverse=True
    )
    index = index.reshape(-1)
    groups = [
        StructureDraws(
            slots=_decode(joints, np.split(row, widths), num_bodies),
            probability=float(weights[index == number].sum()),
            draws=np.flatnonzero(index == number),
        )
        for number, row in enumerate(rows)
    ]
    return sorted(groups, key=lambda group: -group.probability)


def structure_name(
    slots: tuple[Slots, ...], names: tuple[str, ...], *, is_single: bool
) -> str:
    """A readable name: `pin + wheel`, `table pin + table–chair rod`, or `free`.

    Args:
        slots: constraints of the structure.
        names: of the bodies.
        is_single: whether only one body can move, so that it need not be named.
    """
    parts = []
    for kind, body_a, body_b, count in slots:
        ends = [names[body] for body in (body_a, body_b) if body != WORLD]
        is_named = not is_single or len(ends) > 1
        words = [str(count)] if count > 1 else []
        words += ["–".join(ends)] if is_named else []
        words.append(_WORDS[kind] + ("s" if count > 1 else ""))
        parts.append(" ".join(words))
    return " + ".join(parts) if parts else "free"


def report_slots(
    slots: Slots,
    params: Params,
    weights: np.ndarray,
    inferred: Mapping[str, np.ndarray],
    prior_params: Params,
    shift: np.ndarray,
    names: tuple[str, ...],
) -> list[dict]:
    """Summarise the numbers of like constraints, one entry per constraint.

    Args:
        slots: which constraints.
        params: draws that have them, NumPy arrays with a leading draw axis.
        weights: of these draws, sum to one, `[draw]`.
        inferred: by kind, which slots to look at.
        prior_params: prior draws with every inferable slot active.
        shift: centre of mass of each body in its outline's frame `[body, 2]` [m];
            anchors and wheels are reported in the outline's frame.
        names: of the bodies.

    Returns:
        Constraints in the form of a scene file, with a summary for each number. A
        wheel has two more: its offset from the centre of mass along its axle and
        across it [m], of which the data often fix the second alone.
    """
    _, draws = constraint_draws(slots, params, inferred)
    prior_draws, prior = constraint_draws(slots, prior_params, inferred)
    if len(prior_draws) == 0:
        prior = None
    draws, prior = relabel(draws, weights, prior)
    entries = []
    for place in range(slots.count):
        mine = {key: value[:, place] for key, value in draws.items()}
        theirs = prior and {key: value[:, place] for key, value in prior.items()}
        if slots.kind == "wheel":
            centre = axial_mean(mine["pose"][:, 2], weights)
            mine = _along_and_across(mine, centre)
            theirs = theirs and _along_and_across(theirs, centre)
        mine = _to_outline_frame(slots, mine, shift)
        theirs = theirs and _to_outline_frame(slots, theirs, shift)
        entry: dict = {"type": slots.kind, "a": names[slots.body_a]}
        if slots.kind in JOINTS:
            entry["b"] = "world" if slots.body_b == WORLD else names[slots.body_b]
        for key, value in mine.items():
            reference = theirs[key] if theirs else None
            entry[key] = summarise(value, weights, reference, SCALES[key])
        entries.append(entry)
    return entries


def constraint_draws(
    slots: Slots, params: Params, inferred: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Take the numbers of like constraints, symmetries undone.

    Args:
        slots: which constraints.
        params: draws, NumPy arrays with a leading draw axis.
        inferred: by kind, which slots to look at.

    Returns:
        Draws with at least so many of them, and their numbers `[draw, count, ...]`, in
        the frame whose origin is the centre of mass.
    """
    kind, body_a, body_b, count = slots
    group = getattr(params, kind)
    if kind in JOINTS:
        end_a, end_b, is_swapped = _ordered_ends(group)
        matches = group.active & inferred[kind] & (end_a == body_a) & (end_b == body_b)
        numbers = _joint_numbers(group, is_swapped)
    else:
        matches = group.active[:, body_a] & inferred[kind][body_a]
        if kind == "wheel":
            numbers = _fold_wheel(
                group.position[:, body_a],
                group.heading[:, body_a],
                group.viscous[:, body_a],
                group.dry[:, body_a],
            )
        else:
            numbers = {"dry": group.dry[:, body_a], "viscous": group.viscous[:, body_a]}
    rows = np.flatnonzero(matches.sum(axis=1) >= count)
    order = np.argsort(~matches[rows], axis=1, kind="stable")[:, :count]
    return rows, {key: value[rows[:, None], order] for key, value in numbers.items()}


def _joint_numbers(joint: Any, is_swapped: np.ndarray) -> dict[str, np.ndarray]:
    """Numbers of joints from the end with the lower body, axes modulo pi."""
    swap = is_swapped[..., None]
    numbers = {
        "anchor_a": np.where(swap, joint.anchor_b, joint.anchor_a),
        "anchor_b": np.where(swap, joint.anchor_a, joint.anchor_b),
    }
    if hasattr(joint, "axis"):
        axis = joint.axis - np.where(is_swapped, joint.angle, 0.0)
        numbers["axis"] = axial_difference(axis, 0.0)
    if hasattr(joint, "angle"):
        numbers["angle"] = np.where(is_swapped, -joint.angle, joint.angle)
    for name in ("length", "viscous", "dry"):
        if hasattr(joint, name):
            numbers[name] = getattr(joint, name)
    return numbers


def axle_offsets(
    x: np.ndarray, y: np.ndarray, heading: np.ndarray, centre: float
) -> tuple[np.ndarray, np.ndarray]:
    """Offset of a wheel from the centre of mass along and across its own axle [m].

    The axle is square to the heading. Headings are taken modulo pi, each in the sense
    of the mean heading `centre`, so that the signs agree. The offset across is the
    distance of the axle line from the centre of mass.
    """
    heading = centre + axial_difference(heading, centre)
    along = -x * np.sin(heading) + y * np.cos(heading)
    across = x * np.cos(heading) + y * np.sin(heading)
    return along, across


def _ordered_ends(joint: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ends with the lower body first and the world last, and whether they swapped."""
    far = np.iinfo(joint.body_a.dtype).max
    rank_a = np.where(joint.body_a == WORLD, far, joint.body_a)
    rank_b = np.where(joint.body_b == WORLD, far, joint.body_b)
    is_swapped = rank_a > rank_b
    end_a = np.where(is_swapped, joint.body_b, joint.body_a)
    end_b = np.where(is_swapped, joint.body_a, joint.body_b)
    return end_a, end_b, is_swapped


def _decode(
    joints: list[str], codes: list[np.ndarray], num_bodies: int
) -> tuple[Slots, ...]:
    """Read back what `group_by_structure` wrote into one row."""
    slots = []
    num = len(joints)
    for kind, code in zip(joints, codes[:num], strict=True):
        for value, count in zip(*np.unique(code, return_counts=True), strict=True):
            if value >= 0:
                body_a, body_b = divmod(int(value), num_bodies + 1)
                partner = WORLD if body_b == num_bodies else body_b
                slots.append(Slots(kind, body_a, partner, int(count)))
    for kind, counts in zip(("wheel", "ground"), codes[num:], strict=True):
        for body, count in enumerate(counts):
            if count > 0:
                slots.append(Slots(kind, body, WORLD, int(count)))
    return tuple(slots)


def _fold_wheel(
    position: np.ndarray, heading: np.ndarray, viscous: np.ndarray, dry: np.ndarray
) -> dict[str, np.ndarray]:
    """Turn each wheel so that lateral friction is the larger, heading modulo pi."""
    is_tied = viscous[..., 0] == viscous[..., 1]
    is_turned = (viscous[..., 0] > viscous[..., 1]) | (
        is_tied & (dry[..., 0] > dry[..., 1])
    )
    heading = axial_difference(heading + np.where(is_turned, 0.5 * np.pi, 0.0), 0.0)
    turned = is_turned[..., None]
    return {
        "pose": np.concatenate([position, heading[..., None]], axis=-1),
        "viscous": np.where(turned, viscous[..., ::-1], viscous),
        "dry": np.where(turned, dry[..., ::-1], dry),
    }


def relabel(
    draws: dict[str, np.ndarray],
    weights: np.ndarray,
    prior: dict[str, np.ndarray] | None,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray] | None]:
    """Order interchangeable constraints so that like ones are averaged.

    Every draw takes the order that brings it closest to the heaviest draw, distances
    being measured in standard deviations over all draws and places. The prior is
    ordered by the same rule, or a posterior that learnt nothing would look narrower.
    """
    count = next(iter(draws.values())).shape[1]
    if count == 1:
        return draws, prior
    feature = _features(draws)
    pivot = feature[np.argmax(weights)]
    pooled = feature.reshape(-1, feature.shape[-1])
    spread = np.maximum(pooled.std(axis=0), np.finfo(np.float32).tiny)
    draws = _reorder(draws, feature / spread, pivot / spread)
    if prior is not None:
        prior = _reorder(prior, _features(prior) / spread, pivot / spread)
    return draws, prior


def _features(draws: dict[str, np.ndarray]) -> np.ndarray:
    """What tells constraints apart: places and directions, else the numbers' logs."""
    if "pose" in draws:
        heading = 2.0 * draws["pose"][..., 2:]
        parts = [draws["pose"][..., :2], np.cos(heading), np.sin(heading)]
    elif "anchor_a" in draws:
        parts = [draws["anchor_a"], draws["anchor_b"]]
    else:
        logs = (np.log(np.clip(value, 1e-12, 1e12)) for value in draws.values())
        parts = [value[..., None] for value in logs]
    return np.concatenate(parts, axis=-1)


def _reorder(
    draws: dict[str, np.ndarray], feature: np.ndarray, pivot: np.ndarray
) -> dict[str, np.ndarray]:
    """Give each draw the order of places in which it lies closest to the pivot."""
    orders = np.array(list(itertools.permutations(range(pivot.shape[0]))))
    cost = np.stack(
        [((feature[:, order] - pivot[None]) ** 2).sum(axis=(1, 2)) for order in orders]
    )
    best = orders[np.argmin(cost, axis=0)]
    rows = np.arange(len(best))[:, None]
    return {key: value[rows, best] for key, value in draws.items()}


def _along_and_across(
    numbers: dict[str, np.ndarray], centre: float
) -> dict[str, np.ndarray]:
    """Add a wheel's offsets along and across its own axle."""
    x, y, heading = np.moveaxis(numbers["pose"], -1, 0)
    along, across = axle_offsets(x, y, heading, centre)
    return {**numbers, "along_axle": along, "across_axle": across}


def _to_outline_frame(
    slots: Slots, numbers: dict[str, np.ndarray], shift: np.ndarray
) -> dict[str, np.ndarray]:
    """Move anchors and wheels from the centre of mass's frame to the outline's."""
    moved = dict(numbers)
    if "anchor_a" in moved:
        moved["anchor_a"] = moved["anchor_a"] + shift[slots.body_a][None]
        if slots.body_b != WORLD:
            moved["anchor_b"] = moved["anchor_b"] + shift[slots.body_b][None]
    if "pose" in moved:
        offset = np.append(shift[slots.body_a], 0.0)
        moved["pose"] = moved["pose"] + offset[None]
    return moved
