"""From what a file says to what the engine takes: `Scene`, `State` and `Params`."""

from collections.abc import Sequence

import jax
import numpy as np

from boomdp_jax.core.arrays import on_device
from boomdp_jax.physics.body_spec import BodySpec
from boomdp_jax.physics.constraint_spec import (
    JOINTS,
    ConstraintSpec,
    missing_numbers,
)
from boomdp_jax.physics.params import (
    Distance,
    Ground,
    Params,
    Prismatic,
    Revolute,
    Surface,
    Weld,
    Wheel,
)
from boomdp_jax.physics.scene import Scene

MIN_VERTICES = 4
"""Least room for corners, so that scenes of boxes, triangles and circles stack."""

MIN_FEET = 9
"""Least room for feet, likewise."""


DEFAULT_FRICTION, DEFAULT_RESTITUTION = 0.5, 0.0
"""Of a body whose file does not say, in a scene with contact."""


def build_scene(
    bodies: Sequence[BodySpec],
    gravity: np.ndarray,
    normal_gravity: float,
    dt: float,
    substeps: int | None = None,
    *,
    num_vertices: int = MIN_VERTICES,
    num_feet: int = MIN_FEET,
) -> Scene:
    """Lay out the bodies of a scene as arrays.

    Args:
        bodies: bodies in the order of the file.
        gravity: in-plane gravity [m/s²].
        normal_gravity: gravity across the plane [m/s²].
        dt: default length of a step [s].
        substeps: in how many parts a step is made; None: two, four with contact.
        num_vertices: least room for corners of each body.
        num_feet: least room for feet of each body.

    Returns:
        The scene, on the default float type.
    """
    if substeps is None:
        substeps = 4 if has_contact(bodies) else 2
    num_vertices = max(num_vertices, *(len(body.outline) for body in bodies))
    num_feet = max(num_feet, *(len(body.feet) for body in bodies))
    vertex_mask = [np.arange(num_vertices) < len(body.outline) for body in bodies]
    vertices = [_pad_with_last(body.vertices, num_vertices) for body in bodies]
    feet = [_pad_with_last(body.feet, num_feet) for body in bodies]
    loads = [_pad_with_zeros(body.foot_load, num_feet) for body in bodies]
    corners = [_pad_with_zeros(body.corner_load, num_feet) for body in bodies]
    diagonals = [_pad_with_zeros(body.diagonal, num_feet) for body in bodies]
    sizes = [_pad_with_zeros(body.foot_size, num_feet) for body in bodies]
    # Concrete arrays even under a trace: the caller keeps them.
    with jax.ensure_compile_time_eval():
        return Scene(
            vertices=on_device(np.stack(vertices)),
            vertex_mask=on_device(np.stack(vertex_mask), bool),
            radius=on_device([body.radius for body in bodies]),
            area=on_device([body.area for body in bodies]),
            gyration=on_device([body.gyration for body in bodies]),
            feet=on_device(np.stack(feet)),
            foot_load=on_device(np.stack(loads)),
            foot_size=on_device(np.stack(sizes)),
            corner_load=on_device(np.stack(corners)),
            diagonal=on_device(np.stack(diagonals)),
            stance_axis=on_device([body.stance_axis for body in bodies]),
            is_static=on_device([body.is_static for body in bodies], bool),
            gravity=on_device(gravity),
            normal_gravity=on_device(normal_gravity),
            dt=on_device(dt),
            collides=_collides(bodies),
            num_substeps=substeps,
        )


def has_contact(bodies: Sequence[BodySpec]) -> bool:
    """Whether a scene has contact: one of its bodies says what that is like."""
    return len(bodies) > 1 and any(body.has_contact for body in bodies)


def build_surface(bodies: Sequence[BodySpec]) -> Surface | None:
    """Lay out what contact is like.

    Args:
        bodies: bodies in the order of the file.

    Returns:
        Friction and restitution on the default float type, with defaults where a file
        does not say or has them inferred; None in a scene without contact.
    """
    if not has_contact(bodies):
        return None

    def known(number: float | None, default: float) -> float:
        return default if number is None or np.isnan(number) else number

    friction = [known(body.friction, DEFAULT_FRICTION) for body in bodies]
    restitution = [known(body.restitution, DEFAULT_RESTITUTION) for body in bodies]
    return Surface(friction=on_device(friction), restitution=on_device(restitution))


def build_params(
    bodies: Sequence[BodySpec], constraints: Sequence[ConstraintSpec], source: str
) -> Params:
    """Lay out known numbers as a hypothesis, one active slot for each constraint.

    A static body without a density gets 1 kg/m²; nothing depends on it.

    Args:
        bodies: bodies in the order of the file.
        constraints: constraints in the order of the file.
        source: name of the file, for messages.

    Returns:
        The params, on the default float type, unbatched.

    Raises:
        ValueError: something is to be inferred; which body or constraint, which field.
    """
    for body in bodies:
        if body.is_center_unknown:
            _refuse_unknown(source, f"body {body.name!r}", "center_of_mass")
        if body.density is None and not body.is_static:
            _refuse_unknown(source, f"body {body.name!r}", "density")
    for constraint in constraints:
        for field in missing_numbers(constraint):
            owner = f"{constraint.kind} of body {bodies[constraint.body_a].name!r}"
            _refuse_unknown(source, owner, field)
    joints = {kind: [c for c in constraints if c.kind == kind] for kind in JOINTS}
    prismatic, weld = joints["prismatic"], joints["weld"]
    density = [1.0 if body.density is None else body.density for body in bodies]
    return Params(
        density=on_device(density),
        revolute=Revolute(
            **_joint_slots(joints["revolute"]),
            viscous=_stack(joints["revolute"], "viscous"),
            dry=_stack(joints["revolute"], "dry"),
            **_drives(joints["revolute"]),
        ),
        distance=Distance(
            **_joint_slots(joints["distance"]),
            length=_stack(joints["distance"], "length"),
        ),
        wheel=Wheel(
            **_body_slots(
                constraints,
                "wheel",
                len(bodies),
                {"position": (2,), "heading": (), "viscous": (2,), "dry": (2,)},
            )
        ),
        ground=Ground(
            **_body_slots(
                constraints, "ground", len(bodies), {"dry": (), "viscous": ()}
            )
        ),
        surface=build_surface(bodies),
        prismatic=Prismatic(
            **_joint_slots(prismatic),
            **{
                key: _stack(prismatic, key)
                for key in ("axis", "angle", "viscous", "dry")
            },
            **_drives(prismatic),
        )
        if prismatic
        else None,
        weld=Weld(**_joint_slots(weld), angle=_stack(weld, "angle")) if weld else None,
    )


def _drives(joints: Sequence[ConstraintSpec]) -> dict[str, jax.Array]:
    """Ranges and motors, if any of a kind's joints has one."""
    nothing = {"limit": [-np.inf, np.inf], "motor": [0.0, 0.0]}
    return {
        key: on_device(np.array([joint.numbers.get(key, none) for joint in joints]))
        for key, none in nothing.items()
        if any(key in joint.numbers for joint in joints)
    }


def _collides(bodies: Sequence[BodySpec]) -> jax.Array | None:
    """All pairs but those of a group."""
    if not has_contact(bodies):
        return None
    groups = [body.group for body in bodies]
    table = [[g is None or g != h for h in groups] for g in groups]
    return on_device(np.array(table) & ~np.eye(len(bodies), dtype=bool), bool)


def _pad_with_zeros(values: np.ndarray, num: int) -> np.ndarray:
    return np.pad(values, (0, num - len(values)))


def _pad_with_last(points: np.ndarray, num: int) -> np.ndarray:
    """Repeat the last point up to a capacity; zeros where there is none."""
    if not len(points):
        return np.zeros((num, 2))
    return np.pad(points, ((0, num - len(points)), (0, 0)), mode="edge")


def _refuse_unknown(source: str, owner: str, field: str) -> None:
    raise ValueError(f"{source}: {owner}: {field}: expected a number, got unknown")


def _stack(
    constraints: Sequence[ConstraintSpec], key: str, shape: tuple[int, ...] = ()
) -> jax.Array:
    rows = [constraint.numbers[key] for constraint in constraints]
    return on_device(np.reshape(rows, (len(rows), *shape)))


def _joint_slots(joints: Sequence[ConstraintSpec]) -> dict[str, jax.Array]:
    return {
        "active": on_device(np.ones(len(joints)), bool),
        "body_a": on_device([joint.body_a for joint in joints], np.dtype(np.int32)),
        "body_b": on_device([joint.body_b for joint in joints], np.dtype(np.int32)),
        "anchor_a": _stack(joints, "anchor_a", (2,)),
        "anchor_b": _stack(joints, "anchor_b", (2,)),
    }


def _body_slots(
    constraints: Sequence[ConstraintSpec],
    kind: str,
    num_bodies: int,
    shapes: dict[str, tuple[int, ...]],
) -> dict[str, jax.Array]:
    """Slots of a kind that belongs to one body, as many as the busiest body needs."""
    of_body = [
        [c for c in constraints if c.kind == kind and c.body_a == body]
        for body in range(num_bodies)
    ]
    num_slots = max(map(len, of_body))
    active = np.zeros((num_bodies, num_slots), bool)
    arrays = {
        key: np.zeros((num_bodies, num_slots, *shape)) for key, shape in shapes.items()
    }
    for body, own in enumerate(of_body):
        active[body, : len(own)] = True
        for slot, constraint in enumerate(own):
            for key, array in arrays.items():
                array[body, slot] = constraint.numbers[key]
    return {
        "active": on_device(active, bool),
        **{key: on_device(array) for key, array in arrays.items()},
    }
