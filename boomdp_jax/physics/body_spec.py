"""One body of a scene file: its outline as authored, its start, what is known of it."""

import dataclasses
import functools
import math

import numpy as np
from jaxtyping import Float

from boomdp_jax.physics.scene_fields import (
    read_flag,
    read_name,
    read_number,
    read_object,
    read_points,
    read_vector,
    refuse,
)
from boomdp_jax.physics.shapes import (
    CORNER_FEET,
    ShapeMoments,
    box_outline,
    check_outline,
    circle_moments,
    diagonal_loads,
    foot_loads,
    longer_axis,
    polygon_moments,
    support_feet,
)

_SHAPE_FIELDS = {"box": "half_extents", "polygon": "vertices", "circle": "radius"}
_AREA_RANGE = (1e-18, 1e18)
"""What 32 bit floats can multiply and divide [m²]."""
_OPTIONAL_FIELDS = (
    "label",
    "pose",
    "twist",
    "contact",
    "center_of_mass",
    "feet",
    "static",
    "density",
)


@dataclasses.dataclass(frozen=True, eq=False)
class BodySpec:
    """What a scene file says about one body, host side.

    `outline`, `center_of_mass` and `authored_feet` are in the frame in which the author
    drew the outline. `vertices` and `feet` are the same in the frame whose origin is
    the centre of mass, which is what `pose` places and all else refers to. If the
    centre of mass is unknown, the origin of the outline's frame stands in for it.
    """

    name: str
    label: str | None
    """What sort of thing it looks like."""
    kind: str
    """Shape as authored: box, polygon or circle."""
    outline: Float[np.ndarray, "vertex 2"]
    """Corners, counter-clockwise [m]; none for a circle."""
    radius: float
    """Radius of a circle [m]; zero for a polygon."""
    pose: Float[np.ndarray, "3"] | None
    """Where it starts [m, m, rad]; None: the file does not say."""
    twist: Float[np.ndarray, "3"]
    """Rates at the start [m/s, m/s, rad/s]."""
    is_static: bool
    density: float | None
    """Mass per area [kg/m²]; None: to be inferred."""
    authored_feet: Float[np.ndarray, "foot 2"] | None
    """Where it stands on the floor [m]; None: spread over the outline."""
    friction: float | None
    """Contact friction; None: the file does not say; NaN: to be inferred."""
    restitution: float | None
    """Contact restitution, likewise."""
    center_of_mass: Float[np.ndarray, "2"] | None
    """Centre of mass as given [m]; None: the centroid, or unknown."""
    is_center_unknown: bool = False
    """Whether the centre of mass is to be inferred."""
    has_contact: bool = False
    """Whether the file says what contact with it is like."""
    group: str | None = None
    """Bodies of the same group do not touch each other; None: of no group."""

    @functools.cached_property
    def moments(self) -> ShapeMoments:
        """Moments of the outline, as authored."""
        if self.kind == "circle":
            return circle_moments(self.radius)
        return polygon_moments(self.outline)

    @property
    def area(self) -> float:
        """Area of the outline [m²]."""
        return self.moments.area

    @property
    def gyration(self) -> float:
        """Squared radius of gyration about the centre of mass [m²].

        That of the outline about its centroid; a centre of mass that was given
        elsewhere moves the reference point and leaves this number.
        """
        return self.moments.gyration

    @property
    def shift(self) -> Float[np.ndarray, "2"]:
        """Centre of mass in the outline's frame [m]; zero if it is unknown.

        A point of the outline's frame minus this is the same point in the frame of
        the centre of mass.
        """
        if self.is_center_unknown:
            return np.zeros(2)
        if self.center_of_mass is not None:
            return self.center_of_mass
        is_centred = np.max(np.abs(self.moments.centroid)) < 1e-12 * self.reach
        return np.zeros(2) if is_centred else self.moments.centroid

    @property
    def reach(self) -> float:
        """Largest distance of the outline from the origin of its frame [m]."""
        return self.radius + float(np.max(np.hypot(*self.outline.T), initial=0.0))

    @property
    def vertices(self) -> Float[np.ndarray, "vertex 2"]:
        """Corners, counter-clockwise, about the centre of mass [m]."""
        return self.outline - self.shift

    @property
    def feet(self) -> Float[np.ndarray, "foot 2"]:
        """Where it stands on the floor, about the centre of mass [m]."""
        return self._stance[0]

    @property
    def foot_size(self) -> Float[np.ndarray, " foot"]:
        """Size of each foot [m] (`Scene.foot_size`); feet that are given are points."""
        return self._stance[1]

    @functools.cached_property
    def _stance(self) -> tuple[Float[np.ndarray, "foot 2"], Float[np.ndarray, " foot"]]:
        """Where its feet are, and how large."""
        if self.authored_feet is not None:
            return self.authored_feet - self.shift, np.zeros(len(self.authored_feet))
        feet, size = support_feet(self.moments, is_round=self.radius > 0.0)
        return feet, np.full(len(feet), size)

    @property
    def foot_load(self) -> Float[np.ndarray, " foot"]:
        """Share of the weight on each foot."""
        return foot_loads(self.feet)

    @property
    def corner_load(self) -> Float[np.ndarray, " foot"]:
        """Share of the weight on each foot where only the outermost carry."""
        load = self.foot_load
        if self.authored_feet is None:
            load = np.zeros(len(self.feet))
            load[CORNER_FEET] = foot_loads(self.feet[CORNER_FEET])
        return load

    @property
    def diagonal(self) -> Float[np.ndarray, " foot"]:
        """What a diagonal may carry besides, over the load of each foot."""
        return diagonal_loads(self.feet, self.corner_load)

    @property
    def stance_axis(self) -> float:
        """Direction of the longer axis of the outline [rad]."""
        return longer_axis(self.moments)


def read_body(value: object, source: str, index: int) -> BodySpec:
    """Read one entry of `bodies`.

    Args:
        value: the entry.
        source: name of the file, for messages.
        index: place of the entry, for messages.

    Returns:
        The body.

    Raises:
        ValueError: which field is wrong, and how.
    """
    where = f"{source}: bodies[{index}]"
    if isinstance(value, dict) and isinstance(value.get("name"), str):
        where = f"{source}: body {value['name']!r}"
    fields = read_object(
        value, where, required=("name", "shape"), optional=_OPTIONAL_FIELDS
    )
    name = read_name(fields["name"], f"{where}: name")
    if name == "world":
        refuse(f"{where}: name", "a name other than the world's", name)
    label = fields.get("label")
    kind, outline, radius = _read_shape(fields["shape"], f"{where}: shape")
    is_static = read_flag(fields.get("static", False), f"{where}: static")
    contact = read_object(
        fields.get("contact", {}),
        f"{where}: contact",
        optional=("friction", "restitution", "group"),
    )
    group = contact.get("group")
    density = read_number(
        fields.get("density"), f"{where}: density", is_positive=True, is_nullable=True
    )
    body = BodySpec(
        name=name,
        label=None if label is None else read_name(label, f"{where}: label"),
        kind=kind,
        outline=outline,
        radius=radius,
        pose=_read_optional_vector(fields, "pose", where, 3),
        twist=read_vector(fields.get("twist", [0.0, 0.0, 0.0]), f"{where}: twist", 3),
        is_static=is_static,
        density=None if math.isnan(density) else density,
        authored_feet=read_points(fields["feet"], f"{where}: feet")
        if "feet" in fields
        else None,
        friction=_read_contact(contact, "friction", where, most=math.inf),
        restitution=_read_contact(contact, "restitution", where, most=1.0),
        center_of_mass=_read_optional_vector(fields, "center_of_mass", where, 2),
        is_center_unknown="center_of_mass" in fields
        and fields["center_of_mass"] is None,
        has_contact="contact" in fields,
        group=None if group is None else read_name(group, f"{where}: contact.group"),
    )
    _check_body(body, where)
    return body


def body_to_dict(body: BodySpec) -> dict:
    """Write a body as an entry of `bodies`.

    Args:
        body: the body.

    Returns:
        What JSON can hold, and `read_body` reads.
    """
    shape = {
        "box": lambda: {"half_extents": body.outline[2].tolist()},
        "polygon": lambda: {"vertices": body.outline.tolist()},
        "circle": lambda: {"radius": body.radius},
    }[body.kind]()
    entry = {"name": body.name, "label": body.label}
    if body.pose is not None:
        entry["pose"] = body.pose.tolist()
    entry["twist"] = body.twist.tolist()
    numbers = {"friction": body.friction, "restitution": body.restitution}
    contact: dict[str, float | str | None] = {
        key: None if math.isnan(number) else number
        for key, number in numbers.items()
        if number is not None
    }
    if body.group is not None:
        contact["group"] = body.group
    if body.has_contact:
        entry["contact"] = contact
    if body.is_center_unknown:
        entry["center_of_mass"] = None
    elif body.center_of_mass is not None:
        entry["center_of_mass"] = body.center_of_mass.tolist()
    entry["shape"] = {"type": body.kind, **shape}
    if body.authored_feet is not None:
        entry["feet"] = body.authored_feet.tolist()
    return {**entry, "static": body.is_static, "density": body.density}


def _read_shape(
    value: object, where: str
) -> tuple[str, Float[np.ndarray, "vertex 2"], float]:
    """Kind, corners and radius."""
    if not isinstance(value, dict):
        refuse(where, "an object", value)
    kind = value.get("type")
    if not isinstance(kind, str) or kind not in _SHAPE_FIELDS:
        refuse(f"{where}.type", "box, polygon or circle", kind)
    field = _SHAPE_FIELDS[kind]
    size = read_object(value, where, required=("type", field))[field]
    where = f"{where}.{field}"
    if kind == "circle":
        return kind, np.zeros((0, 2)), read_number(size, where, is_positive=True)
    if kind == "box":
        return kind, box_outline(read_vector(size, where, 2, is_positive=True)), 0.0
    vertices = read_points(size, where)
    try:
        check_outline(vertices)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    return kind, vertices, 0.0


def _read_optional_vector(
    fields: dict, field: str, where: str, size: int
) -> np.ndarray | None:
    if fields.get(field) is None:
        return None
    return read_vector(fields[field], f"{where}: {field}", size)


def _read_contact(
    contact: dict, field: str, where: str, *, most: float
) -> float | None:
    if field not in contact:
        return None
    where = f"{where}: contact.{field}"
    return read_number(contact[field], where, least=0.0, most=most, is_nullable=True)


def _check_body(body: BodySpec, where: str) -> None:
    """What no single field shows."""
    with np.errstate(all="ignore"):
        moments = body.moments
    least, most = _AREA_RANGE
    if not least <= moments.area <= most or not least <= moments.gyration <= most:
        refuse(
            f"{where}: shape",
            f"an area and squared radius of gyration from {least:g} to {most:g} m²",
            (moments.area, moments.gyration),
        )
    if body.is_static and body.pose is None:
        refuse(f"{where}: pose", "a pose, as the body is static", None)
    if body.is_static and np.any(body.twist != 0):
        refuse(f"{where}: twist", "zeros, as the body is static", body.twist.tolist())
    if body.center_of_mass is not None and not _is_inside(body):
        refuse(
            f"{where}: center_of_mass",
            "a point of the outline, as no part of a body has a negative mass",
            body.center_of_mass.tolist(),
        )
    if body.kind == "circle" and np.any(body.shift != 0):
        refuse(
            f"{where}: center_of_mass",
            "[0, 0], the centre of the circle (or a polygon for the shape)",
            body.shift.tolist(),
        )


def _is_inside(body: BodySpec) -> bool:
    """Whether the centre of mass that is given lies in the outline, or all but."""
    if body.kind == "circle":
        return True
    edges = np.roll(body.outline, -1, axis=0) - body.outline
    to_center = body.shift - body.outline
    outside = edges[:, 1] * to_center[:, 0] - edges[:, 0] * to_center[:, 1]
    return bool(np.all(outside <= 1e-6 * body.reach * np.hypot(*edges.T)))
