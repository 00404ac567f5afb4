"""What a scene file says: shapes, names, gravity, what is known and what is not."""

import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from boomdp_jax.physics.body_spec import BodySpec, body_to_dict, read_body
from boomdp_jax.physics.constraint_spec import (
    KINDS,
    ConstraintSpec,
    constraint_to_dict,
    read_constraint,
)
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.scene_arrays import (
    build_params,
    build_scene,
    build_surface,
    has_contact,
)
from boomdp_jax.physics.scene_fields import (
    check_finite,
    in_terms_of_json,
    read_count,
    read_flag,
    read_list,
    read_number,
    read_object,
    read_vector,
    refuse,
)
from boomdp_jax.physics.state import State

SCENE_SCHEMA = "planar-scene-1"
"""Version of the file format."""

STANDARD_GRAVITY = 9.81
"""Load on floor and wheels of a scene seen from above, if it gives none [m/s²]."""

ACTUATOR_NUMBERS = ("gain", "bias", "delay")
"""What `unknown.actuator` may list; see `physics.actuator`."""

_MAX_UNKNOWN = 100
_MAX_SUBSTEPS = 256
_OPTIONAL_FIELDS = (
    "gravity",
    "normal_gravity",
    "substeps",
    "constraints",
    "unknown",
    "prior",
)


@dataclasses.dataclass(frozen=True, eq=False)
class SceneSpec:
    """A scene as its file tells it, host side; compared and hashed by identity."""

    bodies: tuple[BodySpec, ...]
    constraints: tuple[ConstraintSpec, ...]
    """Constraints that are known to exist; NaN marks a number to be inferred."""
    gravity: Float[np.ndarray, "2"]
    """In the plane [m/s²]."""
    normal_gravity: float
    """Across the plane [m/s²]."""
    dt: float
    """Default length of a step [s]."""
    unknown: dict[str, int]
    """Most inferred constraints of each kind that one body may have."""
    prior: dict
    """What replaces parts of the default prior, as given."""
    source: str
    """Where it comes from, for messages."""
    unknown_numbers: frozenset[str] = frozenset()
    """What is to be inferred of every body that can move: `center_of_mass`,
    `actuator.gain`, `actuator.bias`, `actuator.delay`."""
    substeps: int | None = None
    """In how many equal parts the engine makes a step, wherever this scene is moved;
    None: two, four with contact, and in `infer` as many as bodies turn fast."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the bodies, in the order of the file."""
        return tuple(body.name for body in self.bodies)

    @property
    def num_bodies(self) -> int:
        """How many bodies there are, static ones included."""
        return len(self.bodies)

    @property
    def is_static(self) -> Bool[np.ndarray, " body"]:
        """Which bodies never move."""
        return np.array([body.is_static for body in self.bodies], bool)

    @property
    def is_center_unknown(self) -> Bool[np.ndarray, " body"]:
        """Of which bodies the centre of mass is to be inferred.

        States, wrenches and anchors of such a body refer to the origin of its outline
        where the body's own entry has null, else to where the centre of mass would be.
        """
        is_any = "center_of_mass" in self.unknown_numbers
        is_each = np.array([body.is_center_unknown for body in self.bodies], bool)
        return (is_each | is_any) & ~self.is_static

    @property
    def pose(self) -> Float[np.ndarray, "body 3"]:
        """Where bodies start [m, m, rad]; NaN where the file does not say."""
        missing = np.full(3, np.nan)
        return np.stack(
            [missing if body.pose is None else body.pose for body in self.bodies]
        )

    @property
    def scene(self) -> Scene:
        """Its arrays, on the default float type; built once for each such type."""
        dtype = jax.dtypes.canonicalize_dtype(float)
        if dtype not in self._scenes:
            self._scenes[dtype] = build_scene(
                self.bodies,
                self.gravity,
                self.normal_gravity,
                self.dt,
                self.substeps,
            )
        return self._scenes[dtype]

    @functools.cached_property
    def _scenes(self) -> dict[np.dtype, Scene]:
        return {}

    @property
    def notes(self) -> tuple[str, ...]:
        """What the reader should know: outlines that were moved to a centre of mass."""
        return tuple(
            f"{self.source}: body {body.name!r}: the centre of mass, to which its pose "
            f"refers, is at ({body.shift[0]:.6g}, {body.shift[1]:.6g}) m of its outline"
            for body in self.bodies
            if np.any(body.shift != 0)
        )

    def index(self, name: str) -> int:
        """Place of a body in the order of the file.

        Args:
            name: name of the body.

        Returns:
            Its index.

        Raises:
            ValueError: no body has this name.
        """
        if name not in self.names:
            refuse(f"{self.source}: body", f"one of {', '.join(self.names)}", name)
        return self.names.index(name)

    def initial_state(self) -> State:
        """The state in which the scene starts.

        Returns:
            Poses and twists, on the default float type.

        Raises:
            ValueError: a body has no pose.
        """
        for body in self.bodies:
            if body.pose is None:
                where = f"{self.source}: body {body.name!r}: pose"
                raise ValueError(f"{where}: expected a pose to start from, got none")
        twist = np.stack([body.twist for body in self.bodies])
        return State(jnp.asarray(self.pose, float), jnp.asarray(twist, float))

    def params(self) -> Params:
        """The one hypothesis that the file tells in full.

        What `unknown` allows is an upper bound, and left out.

        Returns:
            The params.

        Raises:
            ValueError: a number is to be inferred; which body, which field.
        """
        return build_params(self.bodies, self.constraints, self.source)

    def with_surface(self, params: Params) -> Params:
        """Add what the file says of contact to params that say nothing of it.

        Args:
            params: hypotheses, with any batch axes.

        Returns:
            The same with friction and restitution of every body, defaults where they
            are unknown; params that have them, and those of a scene without contact,
            as they are.
        """
        surface = build_surface(self.bodies)
        if surface is None or params.surface is not None:
            return params
        shape = params.density.shape
        surface = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf.astype(params.density.dtype), shape),
            surface,
        )
        return dataclasses.replace(params, surface=surface)

    def to_dict(self) -> dict:
        """What its file would hold, in terms of JSON.

        Returns:
            An object that `scene_spec_from_dict` reads. Anchors of a body whose centre
            of mass is not the origin of its outline agree to rounding.
        """
        substeps = {} if self.substeps is None else {"substeps": self.substeps}
        return {
            "schema": SCENE_SCHEMA,
            "gravity": self.gravity.tolist(),
            "normal_gravity": self.normal_gravity,
            "dt": self.dt,
            **substeps,
            "bodies": [body_to_dict(body) for body in self.bodies],
            "constraints": [
                constraint_to_dict(constraint, self.bodies)
                for constraint in self.constraints
            ],
            "unknown": dict(self.unknown) | _unknown_to_dict(self.unknown_numbers),
            "prior": json.loads(json.dumps(self.prior)),
        }


def scene_spec_from_dict(content: object, source: str = "scene") -> SceneSpec:
    """Read a scene from what its JSON file holds.

    Args:
        content: an object of the schema `planar-scene-1`; arrays may stand for lists,
            and NumPy's numbers for numbers.
        source: name of the file, for messages.

    Returns:
        The scene.

    Raises:
        ValueError: one line with file, body and field, what was expected, what was got.
    """
    try:
        content = in_terms_of_json(content)
    except RecursionError as error:
        raise ValueError(
            f"{source}: expected an object, got one nested too deep"
        ) from error
    if not isinstance(content, dict):
        refuse(source, "an object", content)
    if content.get("schema") != SCENE_SCHEMA:
        refuse(f"{source}: schema", repr(SCENE_SCHEMA), content.get("schema"))
    fields = read_object(
        content, source, required=("schema", "dt", "bodies"), optional=_OPTIONAL_FIELDS
    )
    gravity = read_vector(fields.get("gravity", [0.0, 0.0]), f"{source}: gravity", 2)
    normal_gravity = read_number(
        fields.get("normal_gravity", 0.0 if np.any(gravity != 0) else STANDARD_GRAVITY),
        f"{source}: normal_gravity",
        least=0.0,
    )
    dt = read_number(fields["dt"], f"{source}: dt", is_positive=True)
    substeps = None
    if fields.get("substeps") is not None:
        where = f"{source}: substeps"
        substeps = read_count(fields["substeps"], where, least=1, most=_MAX_SUBSTEPS)
    bodies = _read_bodies(fields["bodies"], source)
    entries = read_list(fields.get("constraints", []), f"{source}: constraints")
    constraints = tuple(
        read_constraint(entry, f"{source}: constraints[{i}]", bodies, normal_gravity)
        for i, entry in enumerate(entries)
    )
    caps = read_object(
        fields.get("unknown", {}),
        f"{source}: unknown",
        optional=(*KINDS, "center_of_mass", "actuator"),
    )
    prior = fields.get("prior", {})
    if not isinstance(prior, dict):
        refuse(f"{source}: prior", "an object", prior)
    check_finite(prior, f"{source}: prior")
    spec = SceneSpec(
        bodies=bodies,
        constraints=constraints,
        gravity=gravity,
        normal_gravity=normal_gravity,
        dt=dt,
        unknown={
            kind: read_count(
                caps.get(kind, 0), f"{source}: unknown.{kind}", most=_MAX_UNKNOWN
            )
            for kind in KINDS
        },
        prior=prior,
        source=source,
        unknown_numbers=_read_unknown_numbers(caps, f"{source}: unknown"),
        substeps=substeps,
    )
    _check_centers(spec)
    return spec


def _read_unknown_numbers(caps: dict, where: str) -> frozenset[str]:
    """Names of numbers of bodies that are to be inferred."""
    numbers = read_list(caps.get("actuator", []), f"{where}.actuator")
    for number in numbers:
        if numbers.count(number) > 1:
            refuse(f"{where}.actuator", "names that differ", f"{number} twice")
        if number not in ACTUATOR_NUMBERS:
            expected = f"a list of some of {', '.join(ACTUATOR_NUMBERS)}"
            refuse(f"{where}.actuator", expected, number)
    names = {f"actuator.{number}" for number in numbers}
    if read_flag(caps.get("center_of_mass", False), f"{where}.center_of_mass"):
        names.add("center_of_mass")
    return frozenset(names)


def _unknown_to_dict(names: frozenset[str]) -> dict:
    """The inverse of `_read_unknown_numbers`."""
    entry: dict = {}
    if "center_of_mass" in names:
        entry["center_of_mass"] = True
    numbers = [n for n in ACTUATOR_NUMBERS if f"actuator.{n}" in names]
    return entry | ({"actuator": numbers} if numbers else {})


def _check_centers(spec: SceneSpec) -> None:
    """Contact takes circles to be about their centre of mass."""
    for body, is_unknown in zip(spec.bodies, spec.is_center_unknown, strict=True):
        if is_unknown and body.kind == "circle" and has_contact(spec.bodies):
            refuse(
                f"{spec.source}: body {body.name!r}: center_of_mass",
                "the centre of the circle, as the scene has contact (or a polygon)",
                None,
            )


def _read_bodies(value: object, source: str) -> tuple[BodySpec, ...]:
    entries = read_list(value, f"{source}: bodies")
    if not entries:
        refuse(f"{source}: bodies", "at least one body", entries)
    bodies = tuple(read_body(entry, source, i) for i, entry in enumerate(entries))
    names = [body.name for body in bodies]
    for name in names:
        if names.count(name) > 1:
            refuse(f"{source}: bodies", "names that differ", f"{name} twice")
    return bodies
