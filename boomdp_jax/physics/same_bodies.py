"""Whether two scenes have the same bodies, so that numbers of the one fit the other."""

import reprlib

import numpy as np
from jaxtyping import Float

from boomdp_jax.physics.body_spec import BodySpec, body_to_dict
from boomdp_jax.physics.scene_fields import refuse
from boomdp_jax.physics.scene_spec import SceneSpec

_TOLERANCE = 1e-6
"""Of a corner, as a share of the outline's reach: some roundings to 32 bit."""


def check_same_bodies(
    got: SceneSpec, wanted: SceneSpec, where: str, as_in: str = ""
) -> None:
    """Refuse hypotheses for other bodies: other names, or other outlines.

    Densities, anchors and wheels mean something else about another outline.

    Args:
        got: the scene for which the hypotheses are.
        wanted: the scene that they are to be used with.
        where: what holds the hypotheses, for messages.
        as_in: where the scene comes from, for messages.

    Raises:
        ValueError: they differ; which body, how.
    """
    if got.names != wanted.names:
        raise ValueError(
            f"{where}: expected bodies {', '.join(wanted.names)[:200]}{as_in}, got "
            f"{', '.join(got.names)[:200]}"
        )
    for other, body in zip(got.bodies, wanted.bodies, strict=True):
        if not _is_same(body, other):
            field, expected, found = _difference(body, other)
            refuse(
                f"{where}: body {body.name!r}: {field}",
                f"{reprlib.repr(expected)}{as_in}",
                found,
            )


def _is_same(body: BodySpec, other: BodySpec) -> bool:
    """Whether outlines agree about the points to which poses refer.

    By shape, not by how it is written: a box may be a polygon of its corners.
    """
    tolerance = _TOLERANCE * body.reach
    if abs(body.radius - other.radius) > tolerance:
        return False
    ours, theirs = body.vertices, other.vertices
    if ours.shape != theirs.shape:
        return False
    if not len(ours):
        return True  # A circle's centre is where its pose is.
    # Corners may be told from any of them on.
    nearest = int(np.argmin(np.hypot(*(theirs - ours[0]).T)))
    return _is_near(ours, np.roll(theirs, -nearest, axis=0), tolerance)


def _is_near(
    ours: Float[np.ndarray, "vertex 2"],
    theirs: Float[np.ndarray, "vertex 2"],
    tolerance: float,
) -> bool:
    return bool(np.max(np.abs(ours - theirs)) <= tolerance)


def _difference(body: BodySpec, other: BodySpec) -> tuple[str, object, object]:
    """The first field that differs, with both of its values."""
    ours, theirs = body_to_dict(body)["shape"], body_to_dict(other)["shape"]
    same_kind = ours["type"] == theirs["type"]
    if not same_kind or body.outline.shape != other.outline.shape:
        return "shape", ours, theirs
    tolerance = _TOLERANCE * body.reach
    if body.kind == "polygon":
        apart = np.max(np.abs(body.outline - other.outline), axis=1) > tolerance
        if np.any(apart):
            corner = int(np.argmax(apart))
            pair = (ours["vertices"][corner], theirs["vertices"][corner])
            return (f"shape.vertices[{corner}]", *pair)
    elif body.kind == "circle" and body.radius != other.radius:
        return "shape.radius", ours["radius"], theirs["radius"]
    elif body.kind == "box" and not _is_near(body.outline, other.outline, tolerance):
        return "shape.half_extents", ours["half_extents"], theirs["half_extents"]
    return "center_of_mass", _center(body), _center(other)


def _center(body: BodySpec) -> list[float] | None:
    return None if body.is_center_unknown else body.shift.tolist()
