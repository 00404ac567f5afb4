"""A structure that a user names, and the scene in which it is known to hold."""

import collections
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from boomdp_jax.core.history import History
from boomdp_jax.inference.blocks.block import Block, make_block
from boomdp_jax.inference.hypotheses.layout import Layout, SlotKey, block_layout
from boomdp_jax.inference.hypotheses.redundancy import NEW_KINDS, Tie, is_redundant
from boomdp_jax.inference.hypotheses.slot_shapes import JOINT_SHAPES
from boomdp_jax.inference.members import naming
from boomdp_jax.inference.readings.components import independent_blocks
from boomdp_jax.inference.readings.touching import find_touching
from boomdp_jax.physics.constraint_spec import JOINTS, KINDS, ConstraintSpec
from boomdp_jax.physics.params import WORLD
from boomdp_jax.physics.scene_spec import SceneSpec

Structure = Mapping[str, Sequence[Any]]
"""Inferred constraints by body: `{"table": ["revolute", "wheel"]}`; a joint with
another body is a pair, `{"cart": [("revolute", "pole")]}`."""

# Numbers of each kind, as a scene file with nulls would have them.
_NUMBERS: dict[str, dict[str, tuple[int, ...]]] = {
    **{
        kind: {name: shape for name, shape in shapes.items() if name != "active"}
        for kind, shapes in JOINT_SHAPES.items()
    },
    "wheel": {"position": (2,), "heading": (), "viscous": (2,), "dry": (2,)},
    "ground": {"viscous": (), "dry": ()},
}


def scene_layout(spec: SceneSpec) -> Layout:
    """Slots of all bodies that can move, as if they were one block.

    Args:
        spec: the scene.

    Returns:
        The layout; its body indices count among the bodies that can move.
    """
    return block_layout(spec, tuple(np.flatnonzero(~spec.is_static).tolist()))


def structure_of_slots(spec: SceneSpec, slots: Sequence[SlotKey]) -> dict[str, list]:
    """Name the constraints of slots.

    Args:
        spec: the scene.
        slots: with body indices of the scene.

    Returns:
        The structure in readable form.
    """
    structure: dict[str, list] = {}
    for slot in slots:
        entry = (
            slot.kind if slot.body_b == WORLD else (slot.kind, spec.names[slot.body_b])
        )
        structure.setdefault(spec.names[slot.body_a], []).append(entry)
    return structure


def fix_structure(
    spec: SceneSpec, structure: Structure | Bool[np.ndarray, " slot"] | None = None
) -> SceneSpec:
    """The scene in which a structure is known, with all its numbers to be inferred.

    Args:
        spec: the scene, whose `unknown` says what may exist.
        structure: constraints that exist besides the known ones; in readable form, or
            which slots of `scene_layout(spec)` are active. Default: none.

    Returns:
        A scene with the constraints added to the known ones and nothing else unknown.

    Raises:
        ValueError: a body, kind or partner that the scene does not have, more
            constraints of a kind than it allows, or some that fewer say as well.
    """
    if structure is None:
        structure = {}
    if not isinstance(structure, Mapping):
        structure = _from_mask(spec, np.asarray(structure))
    added = [
        item
        for name, entries in structure.items()
        for item in _read_entries(spec, name, entries)
    ]
    _check_caps(spec, added)
    _check_redundancy(spec, added)
    constraints = tuple(
        ConstraintSpec(
            kind,
            body_a,
            body_b,
            {key: np.full(shape, np.nan) for key, shape in _NUMBERS[kind].items()},
            frozenset(),
        )
        for kind, body_a, body_b in added
    )
    return dataclasses.replace(
        spec,
        constraints=spec.constraints + constraints,
        unknown=dict.fromkeys(KINDS, 0),
    )


def check_structure(
    specs: Sequence[SceneSpec],
    method: str,
    structure: Structure | Bool[np.ndarray, " slot"] | None,
) -> None:
    """Raise unless a structure goes with a method of `infer`, and with all scenes.

    Raises:
        ValueError: a structure where the method finds it, or as in `fix_structure`.
    """
    if structure is None:
        return
    if method not in ("nuts", "svi"):
        raise ValueError(f"structure: expected none with method {method!r}")
    different = different_scenes(specs)
    for index, spec in different.items():
        with naming(index, len(different)):
            fix_structure(spec, structure)


def different_scenes(specs: Sequence[SceneSpec]) -> dict[int, SceneSpec]:
    """Scenes that are not the same object as an earlier one, by their numbers."""
    first: dict[int, int] = {}
    for index, spec in enumerate(specs):
        first.setdefault(id(spec), index)
    return {index: specs[index] for index in first.values()}


def structure_blocks(
    spec: SceneSpec,
    history: History,
    structure: Structure | Bool[np.ndarray, " slot"] | None = None,
) -> list[Block]:
    """Independent blocks of a scene given a structure, with one structure each.

    Args:
        spec: the scene.
        history: readings of all its bodies.
        structure: as in `fix_structure`.

    Returns:
        Blocks whose only structure has every slot active; slots that the scene leaves
        to be inferred are listed as such.

    Raises:
        ValueError: as in `fix_structure`.
    """
    fixed = fix_structure(spec, structure)
    touching = find_touching(fixed, history)
    blocks, _ = independent_blocks(fixed, history, touching)
    num_known = len(spec.constraints)
    return [
        _as_inferred(make_block(fixed, b, history, touching=touching), num_known)
        for b in blocks
    ]


def _as_inferred(block: Block, num_known: int) -> Block:
    """Move the constraints that were added from the known slots to the inferred."""
    layout = block.layout
    added = tuple(
        slot._replace(known=-1)
        for slot in layout.known_slots
        if slot.known >= num_known
    )
    kept = tuple(slot for slot in layout.known_slots if slot.known < num_known)
    layout = layout._replace(slots=layout.slots + added, known_slots=kept)
    likelihood: Any = block.target.log_likelihood
    coordinates = dataclasses.replace(likelihood.coordinates, layout=layout)
    structures = jnp.ones((1, len(layout.slots)), bool)
    target = dataclasses.replace(
        block.target,
        log_likelihood=dataclasses.replace(
            likelihood, coordinates=coordinates, structures=structures
        ),
        structures=structures,
        log_prior=jnp.zeros(1),
        slot=jnp.asarray(layout.slot_of_coordinate(), jnp.int32),
    )
    return block._replace(layout=layout, target=target)


def _check_redundancy(spec: SceneSpec, added: list[tuple[str, int, int]]) -> None:
    """Refuse constraints that leave bodies no motion, but for a weld alone."""
    known = [Tie(c.kind, c.body_a, c.body_b, False) for c in spec.constraints]
    ties = known + [Tie(*each, True) for each in added]
    has_new = any(tie.kind in NEW_KINDS for tie in ties)
    if has_new and is_redundant(ties):
        kinds = ", ".join(tie.kind for tie in ties)
        raise ValueError(
            f"{spec.source}: structure: expected constraints that say more than a weld "
            f"between their bodies, or that weld alone; got {kinds}"
        )


def _from_mask(spec: SceneSpec, mask: np.ndarray) -> dict[str, list]:
    """Readable form of a choice of slots."""
    slots = scene_layout(spec).slots
    if mask.dtype != bool or mask.shape != (len(slots),):
        names = [" ".join(map(str, _describe(spec, slot))) for slot in slots]
        raise ValueError(
            f"structure: expected a mapping from body to kinds, or {len(slots)} "
            f"booleans ({', '.join(names) or 'no slot'}); got {mask.dtype} of shape "
            f"{mask.shape}"
        )
    movable = np.flatnonzero(~spec.is_static)
    active = [
        slot._replace(
            body_a=int(movable[slot.body_a]),
            body_b=WORLD if slot.body_b == WORLD else int(movable[slot.body_b]),
        )
        for slot, is_active in zip(slots, mask, strict=True)
        if is_active
    ]
    return structure_of_slots(spec, active)


def _describe(spec: SceneSpec, slot: SlotKey) -> tuple:
    """Body, kind and partner of a slot of `scene_layout`."""
    movable = np.flatnonzero(~spec.is_static)
    words = (spec.names[movable[slot.body_a]], slot.kind)
    return words if slot.body_b == WORLD else (*words, spec.names[movable[slot.body_b]])


def _read_entries(
    spec: SceneSpec, name: str, entries: object
) -> list[tuple[str, int, int]]:
    """Kind and bodies of each constraint of one body."""
    movable = [n for n, s in zip(spec.names, spec.is_static, strict=True) if not s]
    where = f"{spec.source}: structure"
    if name not in movable:
        raise ValueError(
            f"{where}: expected a body that can move ({', '.join(movable)}), got "
            f"{name!r}"
        )
    if isinstance(entries, str) or not isinstance(entries, Sequence):
        raise ValueError(
            f"{where}: {name}: expected a list of kinds ({', '.join(KINDS)}), got "
            f"{entries!r}"
        )
    found = []
    for entry in entries:
        kind, partner = _split(entry)
        if kind not in KINDS:
            raise ValueError(
                f"{where}: {name}: expected one of {', '.join(KINDS)}; got {entry!r}"
            )
        body_a, body_b = spec.index(name), WORLD
        if partner != "world":
            others = [other for other in movable if other != name]
            if kind not in JOINTS or partner not in others:
                expected = "the world" if kind not in JOINTS else ", ".join(others)
                raise ValueError(
                    f"{where}: {name}: {kind}: expected as partner {expected}; got "
                    f"{partner!r}"
                )
            body_a, body_b = sorted((body_a, spec.index(partner)))
        found.append((kind, body_a, body_b))
    return found


def _split(entry: Any) -> tuple[str, str]:
    """Kind and partner of an entry; no kind where it is not one."""
    if isinstance(entry, str):
        return entry, "world"
    if isinstance(entry, Sequence) and len(entry) == 2:
        return str(entry[0]), str(entry[1])
    return "", "world"


def _check_caps(spec: SceneSpec, added: list[tuple[str, int, int]]) -> None:
    """Refuse what the scene's caps on unknown constraints do not allow."""
    used: collections.Counter = collections.Counter()
    pairs: collections.Counter = collections.Counter()
    for kind, body_a, body_b in added:
        used[kind, body_a] += 1
        if body_b != WORLD:
            used[kind, body_b] += 1
            pairs[kind, body_a, body_b] += 1
    for (kind, body), count in used.items():
        cap = spec.unknown.get(kind, 0)
        reason = f"the scene's unknown.{kind}"
        if kind not in JOINTS and spec.normal_gravity <= 0:
            cap, reason = 0, "nothing presses bodies to the floor"
        if count > cap:
            raise ValueError(
                f"{spec.source}: structure: {spec.names[body]}: {kind}: expected at "
                f"most {cap} ({reason}), got {count}"
            )
    for (kind, body_a, body_b), count in pairs.items():
        if count > 1:
            raise ValueError(
                f"{spec.source}: structure: {spec.names[body_a]}: {kind}: expected at "
                f"most one with {spec.names[body_b]}, got {count}"
            )
