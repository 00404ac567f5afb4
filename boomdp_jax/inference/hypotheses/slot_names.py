"""Names of physical numbers by body and constraint: `table.revolute.anchor_a`."""

import collections

import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.inference.hypotheses.body_numbers import get_number
from boomdp_jax.inference.hypotheses.layout import Layout, SlotKey
from boomdp_jax.physics.constraint_spec import JOINTS
from boomdp_jax.physics.params import WORLD, Params

_FIELDS = {
    "revolute": ("anchor_a", "anchor_b", "viscous", "dry"),
    "distance": ("anchor_a", "anchor_b", "length"),
    "prismatic": ("anchor_a", "anchor_b", "axis", "angle", "viscous", "dry"),
    "weld": ("anchor_a", "anchor_b", "angle"),
    "wheel": ("position", "heading", "viscous", "dry", "half_track"),
    "ground": (
        "dry",
        "viscous",
        "torque_share",
        "load_shift",
        "stance_scale",
        "corner_share",
        "diagonal_share",
    ),
}


def slot_names(names: tuple[str, ...], layout: Layout) -> dict[SlotKey, str]:
    """A name for every slot of a block.

    Args:
        names: of the block's bodies.
        layout: its slots.

    Returns:
        `body.kind`, `body.kind_to_partner` for a joint with another body; the second
        one like it ends in `_2`.
    """
    found, counts = {}, collections.Counter()
    for slot in layout.known_slots + layout.slots:
        name = f"{names[slot.body_a]}.{slot.kind}"
        if slot.body_b != WORLD:
            name += f"_to_{names[slot.body_b]}"
        counts[name] += 1
        found[slot] = name if counts[name] == 1 else f"{name}_{counts[name]}"
    return found


def physical_numbers(
    names: tuple[str, ...], layout: Layout, params: Params, area: Float[Array, " body"]
) -> dict[str, Array]:
    """Every number of a block's hypothesis, by name.

    Args:
        names: of the block's bodies.
        layout: its slots.
        params: one hypothesis about the block.
        area: of the bodies' outlines [m²].

    Returns:
        Density [kg/m²] and mass [kg] of each body, what else is inferred of it, and the
        numbers of each slot, in the units of `physics.params`; zero where a slot is not
        active.
    """
    numbers = {}
    for index, name in enumerate(names):
        numbers[f"{name}.density"] = params.density[index]
        numbers[f"{name}.mass"] = params.density[index] * area[index]
    for number in layout.numbers:
        value = get_number(params, number.name)[number.body]
        numbers[f"{names[number.body]}.{number.name}"] = value
    for slot, name in slot_names(names, layout).items():
        group = getattr(params, slot.kind)
        is_joint = slot.kind in JOINTS
        place = slot.index if is_joint else (slot.body_a, slot.index)
        for field in _FIELDS[slot.kind]:
            numbers[f"{name}.{field}"] = getattr(group, field)[place]
    return numbers


def known_numbers(
    names: tuple[str, ...],
    layout: Layout,
    known: dict[int, dict[str, Float[Array, "..."]]],
    density: Float[Array, " body"],
) -> set[str]:
    """Which of `physical_numbers` a scene gives in full.

    Args:
        names: of the block's bodies.
        layout: its slots.
        known: numbers of known constraints by entry; NaN where they are inferred.
        density: of the bodies, NaN where it is inferred [kg/m²].

    Returns:
        Their names.
    """
    found = set()
    for name, value in zip(names, np.asarray(density), strict=True):
        if np.isfinite(value):
            found |= {f"{name}.density", f"{name}.mass"}
    for slot, name in slot_names(names, layout).items():
        for field, value in known.get(slot.known, {}).items():
            if not np.any(np.isnan(np.asarray(value))):
                found.add(f"{name}.{field}")
    return found
