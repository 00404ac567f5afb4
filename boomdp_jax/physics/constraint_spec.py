"""One known constraint of a scene file, and the friction law that its numbers mean."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from boomdp_jax.physics.body_spec import BodySpec
from boomdp_jax.physics.friction import KNEE_SPEED
from boomdp_jax.physics.params import WORLD
from boomdp_jax.physics.scene_fields import (
    read_number,
    read_object,
    read_vector,
    refuse,
)

JOINTS = ("revolute", "distance", "prismatic", "weld")
"""Kinds that have a partner."""

KINDS = (*JOINTS, "wheel", "ground")
"""Every kind of constraint, in the order of reports."""

_ENDS = ("type", "a", "b", "anchor_a", "anchor_b")
_RANGE = ("lower", "upper")
_MOTOR_FIELDS = {
    "revolute": ("motor_speed", "motor_torque"),
    "prismatic": ("motor_speed", "motor_force"),
}
_FIELDS = {
    "revolute": (_ENDS, ("viscous", "dry", *_RANGE, *_MOTOR_FIELDS["revolute"])),
    "distance": ((*_ENDS, "length"), ()),
    "wheel": (("type", "a", "pose"), ("viscous", "dry")),
    "ground": (("type", "a"), ("viscous", "dry")),
    "prismatic": (
        (*_ENDS, "axis"),
        ("angle", "viscous", "dry", *_RANGE, *_MOTOR_FIELDS["prismatic"]),
    ),
    "weld": (_ENDS, ("angle",)),
}


@dataclasses.dataclass(frozen=True, eq=False)
class ConstraintSpec:
    r"""A constraint that is known to exist.

    `numbers` has the keys and units of the kind's class in `physics.params`, with
    anchors and wheel positions about the centre of mass; NaN is a number to be
    inferred. `limit` and `motor` are there only if the file gives them. `derived`
    names those that the file leaves out: the viscous coefficient that follows from a
    dry limit, $c = d / v_k$ with `KNEE_SPEED` $v_k$ (for ground $c = \mu m g / v_k$,
    so NaN until the mass is known), or an infinite dry limit.
    """

    kind: str
    body_a: int
    body_b: int
    """Partner; `WORLD` for the world and for wheel and ground, which have none."""
    numbers: dict[str, np.ndarray]
    derived: frozenset[str]

    @property
    def is_known(self) -> bool:
        """Whether nothing about it is left to infer, but what follows from a mass."""
        return all(
            not np.any(np.isnan(number))
            for key, number in self.numbers.items()
            if not (self.kind == "ground" and key in self.derived)
        )


def read_constraint(
    value: object, where: str, bodies: Sequence[BodySpec], normal_gravity: float
) -> ConstraintSpec:
    """Read one entry of `constraints`.

    Args:
        value: the entry.
        where: file and entry, for messages.
        bodies: bodies of the scene.
        normal_gravity: gravity across the plane [m/s²].

    Returns:
        The constraint.

    Raises:
        ValueError: which field is wrong, and how.
    """
    if not isinstance(value, dict):
        refuse(where, "an object", value)
    kind = value.get("type")
    if not isinstance(kind, str) or kind not in KINDS:
        refuse(f"{where}: type", f"one of {', '.join(KINDS)}", kind)
    required, optional = _FIELDS[kind]
    where = f"{where} ({kind})"
    fields = read_object(value, where, required=required, optional=optional)
    names = [body.name for body in bodies]
    body_a = _read_body_name(fields["a"], f"{where}: a", names)
    if kind in JOINTS:
        body_b = _read_partner(fields["b"], f"{where}: b", names, body_a)
        numbers = _read_joint(fields, where, kind, bodies[body_a], body_b, bodies)
        is_static = body_b == WORLD or bodies[body_b].is_static
        is_static = is_static and bodies[body_a].is_static
    else:
        body_b, numbers = WORLD, {}
        is_static = bodies[body_a].is_static
    if is_static:
        refuse(f"{where}: a", "a body that can move", fields["a"])
    if kind == "wheel":
        pose = read_vector(fields["pose"], f"{where}: pose", 3, is_nullable=True)
        numbers["position"] = pose[:2] - bodies[body_a].shift
        numbers["heading"] = pose[2]
    derived = frozenset()
    if kind not in ("distance", "weld"):
        friction, derived = _read_friction(
            fields, where, kind, bodies[body_a], normal_gravity
        )
        numbers |= friction
    if kind in _MOTOR_FIELDS:
        numbers |= _read_drive(fields, where, kind)
    numbers = {key: np.asarray(number, float) for key, number in numbers.items()}
    return ConstraintSpec(kind, body_a, body_b, numbers, derived)


def constraint_to_dict(
    constraint: ConstraintSpec, bodies: Sequence[BodySpec]
) -> dict[str, object]:
    """Write a constraint as an entry of `constraints`.

    Args:
        constraint: the constraint.
        bodies: bodies of the scene.

    Returns:
        What JSON can hold, and `read_constraint` reads.
    """
    a, b = constraint.body_a, constraint.body_b
    numbers = dict(constraint.numbers)
    entry: dict[str, object] = {"type": constraint.kind, "a": bodies[a].name}
    if constraint.kind in JOINTS:
        entry["b"] = "world" if b == WORLD else bodies[b].name
        numbers["anchor_a"] = numbers["anchor_a"] + bodies[a].shift
        numbers["anchor_b"] = numbers["anchor_b"] + _shift(b, bodies)
    if constraint.kind == "wheel":
        position = numbers.pop("position") + bodies[a].shift
        numbers = {"pose": np.append(position, numbers.pop("heading")), **numbers}
    for key, number in numbers.items():
        if key in ("limit", "motor"):
            names = _RANGE if key == "limit" else _MOTOR_FIELDS[constraint.kind]
            values = zip(names, number.tolist(), strict=True)
            entry |= {name: value for name, value in values if math.isfinite(value)}
        elif key not in constraint.derived:
            entry[key] = _with_nulls(number.tolist())
    return entry


def missing_numbers(constraint: ConstraintSpec) -> list[str]:
    """Names of the numbers that are to be inferred.

    Args:
        constraint: the constraint.

    Returns:
        Keys of `numbers`; a ground's viscous coefficient only if the file has it null.
    """
    return [
        key
        for key, number in constraint.numbers.items()
        if np.any(np.isnan(number))
        and not (constraint.kind == "ground" and key in constraint.derived)
    ]


def _with_nulls(number: float | list) -> float | list | None:
    if isinstance(number, list):
        return [_with_nulls(inner) for inner in number]
    return None if math.isnan(number) else number


def _shift(body: int, bodies: Sequence[BodySpec]) -> Float[np.ndarray, "2"]:
    return np.zeros(2) if body == WORLD else bodies[body].shift


def _read_body_name(value: object, where: str, names: list[str]) -> int:
    if not isinstance(value, str) or value not in names:
        refuse(where, f"the name of a body ({', '.join(names)[:200]})", value)
    return names.index(value)


def _read_partner(value: object, where: str, names: list[str], body_a: int) -> int:
    body_b = WORLD
    if value != "world":
        body_b = _read_body_name(value, where, [*names, "world"])
    if body_a == body_b:
        refuse(where, "another body than a", value)
    return body_b


def _read_joint(
    fields: dict,
    where: str,
    kind: str,
    body_a: BodySpec,
    body_b: int,
    bodies: Sequence[BodySpec],
) -> dict[str, object]:
    """Anchors about the centres of mass, and what else a kind holds."""
    anchor_a, anchor_b = (
        read_vector(fields[key], f"{where}: {key}", 2, is_nullable=True)
        for key in ("anchor_a", "anchor_b")
    )
    numbers: dict[str, object] = {
        "anchor_a": anchor_a - body_a.shift,
        "anchor_b": anchor_b - _shift(body_b, bodies),
    }
    if kind == "distance":
        numbers["length"] = read_number(
            fields["length"], f"{where}: length", is_positive=True, is_nullable=True
        )
    if kind == "prismatic":
        numbers["axis"] = read_number(
            fields["axis"], f"{where}: axis", is_nullable=True
        )
    if kind in ("prismatic", "weld"):
        numbers["angle"] = read_number(
            fields.get("angle", 0.0), f"{where}: angle", is_nullable=True
        )
    return numbers


def _read_drive(fields: dict, where: str, kind: str) -> dict[str, object]:
    """Range and motor of a joint, if there are any."""
    numbers: dict[str, object] = {}
    if any(key in fields for key in _RANGE):
        lower, upper = (
            read_number(fields[key], f"{where}: {key}") if key in fields else default
            for key, default in zip(_RANGE, (-math.inf, math.inf), strict=True)
        )
        if lower > upper:
            refuse(f"{where}: upper", f"a number of at least {lower:g} (lower)", upper)
        numbers["limit"] = [lower, upper]
    names = _MOTOR_FIELDS[kind]
    given = [key in fields for key in names]
    if any(given):
        for key, is_there in zip(names, given, strict=True):
            if not is_there:
                refuse(where, f"a field {key!r} beside the motor's other", list(fields))
        speed, strength = names
        numbers["motor"] = [
            read_number(fields[speed], f"{where}: {speed}"),
            read_number(fields[strength], f"{where}: {strength}", least=0.0),
        ]
    return numbers


def _read_friction(
    fields: dict, where: str, kind: str, body: BodySpec, normal_gravity: float
) -> tuple[dict[str, np.ndarray], frozenset[str]]:
    """Viscous coefficient and dry limit, with what the file leaves out filled in."""
    shape = (2,) if kind == "wheel" else ()
    given = {}
    for key in ("viscous", "dry"):
        if key in fields and kind == "wheel":
            given[key] = read_vector(
                fields[key], f"{where}: {key}", 2, least=0.0, is_nullable=True
            )
        elif key in fields:
            given[key] = np.asarray(
                read_number(fields[key], f"{where}: {key}", least=0.0, is_nullable=True)
            )
    if not given and kind not in ("revolute", "prismatic"):
        refuse(where, "a field 'viscous' or 'dry' (null: to be inferred)", list(fields))
    derived = frozenset({"viscous", "dry"} - given.keys())
    if not given:
        given["viscous"] = np.zeros(shape)
    if "dry" not in given:
        given["dry"] = np.full(shape, np.inf)
    if "viscous" not in given:
        limit = given["dry"]
        if kind == "ground":
            mass = math.nan if body.density is None else body.density * body.area
            limit = limit * mass * normal_gravity
        given["viscous"] = np.asarray(limit / KNEE_SPEED)
    return {"viscous": given["viscous"], "dry": given["dry"]}, derived
