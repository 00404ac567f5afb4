"""A planar scene with one hypothesis as a MuJoCo document, names and all.

The plane is MuJoCo's x-y plane. A body's frame is that of its pose; one that no joint
holds has the joints `NAME.x`, `NAME.y` and `NAME.theta`, whose coordinates are its
pose. Any other has the joint that holds it: `NAME.pin`, whose coordinate is theta_a -
theta_b, `NAME.slide`, or none if it is welded. The key frame `start` is the scene's
start. What is not exactly the engine's law is listed in a comment at the top.
"""

import dataclasses
import math
import os
import xml.etree.ElementTree as ET
from typing import get_args

import jax
import numpy as np

from boomdp_jax.core.atomic import atomic_write
from boomdp_jax.interop.mjcf_drives import add_ground, add_joint_laws, add_wheel
from boomdp_jax.interop.mjcf_elements import (
    HALF_THICKNESS,
    numbers,
    shape,
    surface,
    turned,
)
from boomdp_jax.interop.mjcf_integrator import Integrator, usual_integrator
from boomdp_jax.interop.mjcf_tree import (
    Hold,
    Joint,
    active_joints,
    hang,
    rest_poses,
    start_coordinates,
)
from boomdp_jax.physics.params import WORLD, Params
from boomdp_jax.physics.scene_arrays import has_contact
from boomdp_jax.physics.scene_fields import in_terms_of_json, read_number, refuse
from boomdp_jax.physics.scene_spec import SceneSpec

_MOST_TIME_STEP = 0.002
"""MuJoCo's default [s]."""


def to_mjcf(
    spec: SceneSpec,
    params: Params,
    *,
    time_step: float | None = None,
    integrator: Integrator | None = None,
) -> str:
    """Write a scene and one hypothesis as a document in MuJoCo's XML format.

    Exact are bodies, pins, drawers, welds, motors, viscous friction, and wheels and
    joint friction that do not reach a limit. Near are (and said in the document):
    ranges, rods and joints that close a loop, which are MuJoCo's soft constraints; dry
    friction of joints; limits of a wheel, a box where ours are an ellipse; the floor
    under feet, whose friction on what slides is within 6 % in size and up to 22.5° off
    its direction; contact and restitution. All but the box and the floor go with the
    time step.

    "RK4", at four times the cost, has a double pendulum 1e-6 rad off after 1 s, others
    0.01. It and "Euler" take time steps under mass over viscous coefficient: choose
    "implicitfast" for what is stiffer, hits or has to be fast, but it has carts up to a
    third of their way off, and in MJX, which lacks "implicit", no limits of forces.

    Args:
        spec: the scene; its own densities and constraints do not count.
        params: one hypothesis, unbatched, as `spec.params()` or a draw of a posterior.
        time_step: MuJoCo's own [s]; default: the longest to 2 ms that divides `dt`.
        integrator: default: "RK4"; "implicitfast" if stiff or (no wheels) touching.

    Returns:
        The document. Push a body by `xfrc_applied`, at its centre of mass.

    Raises:
        ValueError: params that are not one hypothesis for this scene, a time step or
            integrator that MuJoCo lacks, or what it cannot express: a drawer, or a pin
            with friction, range or motor, that closes a loop; numbers of actuators; a
            body with two floors.
    """
    host = _on_host(spec, params)
    if time_step is None:
        time_step = spec.dt / max(1, math.ceil(spec.dt / _MOST_TIME_STEP - 1e-9))
    time_step = _read_options(time_step, "RK4" if integrator is None else integrator)
    if integrator is None:
        integrator = usual_integrator(spec, host, time_step)
    return _Writer(spec, host, time_step).write(integrator)


def save_mjcf(
    spec: SceneSpec,
    params: Params,
    path: str | os.PathLike,
    *,
    time_step: float | None = None,
    integrator: Integrator | None = None,
) -> None:
    """Write `to_mjcf`'s document to a file, whole or not at all.

    Args:
        spec: the scene.
        params: one hypothesis.
        path: where to; its folder must exist.
        time_step: MuJoCo's own [s].
        integrator: as of `to_mjcf`.

    Raises:
        ValueError: no path; also from `to_mjcf`.
        OSError: the file cannot be written.
    """
    _check_types(spec, params, path)
    text = to_mjcf(spec, params, time_step=time_step, integrator=integrator)
    atomic_write(path, text.encode())


def _check_types(spec: object, params: object, path: object = "") -> None:
    """Arguments are easily swapped."""
    for name, value, kind, expected in (
        ("spec", spec, SceneSpec, "a SceneSpec"),
        ("params", params, Params, "Params"),
        ("path", path, str | os.PathLike, "a path"),
    ):
        if not isinstance(value, kind):
            raise ValueError(f"{name}: expected {expected}, got {type(value).__name__}")


def _read_options(time_step: object, integrator: object) -> float:
    """The time step, checked, as is the integrator: MuJoCo would fail later."""
    if integrator not in get_args(Integrator):
        refuse("integrator", f"one of {', '.join(get_args(Integrator))}", integrator)
    return read_number(in_terms_of_json(time_step), "time_step", is_positive=True)


def _on_host(spec: SceneSpec, params: Params) -> Params:
    """The hypothesis in double precision, checked."""
    _check_types(spec, params)
    if params.density.ndim != 1:
        raise ValueError(
            f"params: expected one hypothesis, got axes {params.density.shape[:-1]} of "
            "them; take one with jax.tree.map(lambda leaf: leaf[0], params)"
        )
    if params.density.shape != (spec.num_bodies,):
        raise ValueError(
            f"params: expected densities of {spec.num_bodies} bodies, got "
            f"{params.density.shape[0]}"
        )
    if params.actuator is not None:
        raise ValueError(
            "params.actuator: expected none, as a document has no commands, got some; "
            "apply them yourself and give params with actuator=None"
        )

    def convert(leaf: jax.Array | np.ndarray) -> np.ndarray:
        array = np.asarray(leaf)
        return array.astype(np.float64) if array.dtype.kind == "f" else array

    host = jax.tree.map(convert, spec.with_surface(params))
    for body, density in zip(spec.bodies, host.density, strict=True):
        if not body.is_static and not 0 < density < math.inf:
            raise ValueError(
                f"params: body {body.name!r}: expected a density above 0, got {density}"
            )
    return host


@dataclasses.dataclass
class _Writer:
    """A document in the making."""

    spec: SceneSpec
    params: Params
    time_step: float
    notes: list[str] = dataclasses.field(default_factory=list)
    sections: dict[str, ET.Element] = dataclasses.field(
        default_factory=lambda: {
            name: ET.Element(name)
            for name in (
                "asset",
                "worldbody",
                "contact",
                "equality",
                "tendon",
                "actuator",
                "custom",
                "keyframe",
            )
        }
    )
    places: dict[int, ET.Element] = dataclasses.field(default_factory=dict)
    """Element of every body, and of the world."""

    def write(self, integrator: Integrator) -> str:
        holds, loops = hang(self.spec, self.params)
        self.places[WORLD] = self.sections["worldbody"]
        for hold in holds:
            self._add_body(hold)
        for joint in loops:
            self._add_loop(joint)
        rest = rest_poses(holds)
        for rod in active_joints(self.params, ("distance",)):
            self._add_rod(rod, rest)
        self._add_contacts()
        self._add_start(holds)
        record = ET.SubElement(self.sections["custom"], "numeric", name="scene_dt")
        record.set("data", repr(self.spec.dt))
        root = ET.Element("mujoco", model="planar-scene")
        if self.notes:
            lines = "\n    ".join(["Not exactly the engine's laws:", *self.notes])
            root.append(ET.Comment(f" {lines.replace('--', '- -')} "))
        ET.SubElement(root, "compiler", angle="radian")
        gravity = (*self.spec.gravity, -self.spec.normal_gravity)
        option = ET.SubElement(root, "option", timestep=repr(self.time_step))
        option.attrib |= {"gravity": numbers(gravity), "integrator": integrator}
        if len(self.sections["contact"]):
            # MJX fails on elliptic cones where there is no contact.
            option.attrib |= {"cone": "elliptic", "impratio": "10"}
        root.extend(section for section in self.sections.values() if len(section))
        ET.indent(root)
        return ET.tostring(root, encoding="unicode") + "\n"

    def _add_body(self, hold: Hold) -> None:
        """One body: frame, joint, inertia, outline, and what acts on it."""
        body = self.spec.bodies[hold.body]
        element = ET.SubElement(self.places[hold.parent], "body", name=body.name)
        self.places[hold.body] = element
        element.set("pos", numbers((*hold.place, 0.0)))
        if hold.turn:
            element.set("euler", numbers((0.0, 0.0, hold.turn)))
        self._add_joint(element, hold)
        if not body.is_static:
            self._add_inertia(element, hold.body)
        outline = ET.SubElement(element, "geom", name=body.name)
        outline.attrib |= shape(self.sections["asset"], body)
        outline.attrib |= {"contype": "0", "conaffinity": "0"}
        if self.params.surface is not None:
            friction = float(self.params.surface.friction[hold.body])
            bounce = float(self.params.surface.restitution[hold.body])
            outline.attrib |= surface(friction, bounce, self.time_step)
            outline.set("friction", numbers((friction, 0.005, 0.0001)))
        actuators = self.sections["actuator"]
        self.notes += add_wheel(element, actuators, self.spec, self.params, hold.body)
        self.notes += add_ground(element, actuators, self.spec, self.params, hold.body)

    def _add_joint(self, element: ET.Element, hold: Hold) -> None:
        name = self.spec.names[hold.body]
        if hold.kind == "free":
            for suffix, axis in (("x", "1 0 0"), ("y", "0 1 0")):
                ET.SubElement(
                    element, "joint", name=f"{name}.{suffix}", type="slide", axis=axis
                )
            ET.SubElement(
                element, "joint", name=f"{name}.theta", type="hinge", axis="0 0 1"
            )
        if hold.kind not in ("revolute", "prismatic"):
            return
        slots = getattr(self.params, hold.kind)
        sign = 1.0 if hold.is_a else -1.0
        anchor = (slots.anchor_a if hold.is_a else slots.anchor_b)[hold.slot]
        if hold.kind == "revolute":
            joint = ET.SubElement(element, "joint", name=f"{name}.pin", type="hinge")
            joint.set("axis", numbers((0.0, 0.0, sign)))
        else:
            heading = float(slots.axis[hold.slot])
            heading -= float(slots.angle[hold.slot]) if hold.is_a else 0.0
            axis = sign * turned(np.array([1.0, 0.0]), heading)
            joint = ET.SubElement(element, "joint", name=f"{name}.slide", type="slide")
            joint.set("axis", numbers((*axis, 0.0)))
        joint.set("pos", numbers((*anchor, 0.0)))
        actuators = self.sections["actuator"]
        self.notes += add_joint_laws(joint, actuators, slots, hold.slot, self.time_step)

    def _add_inertia(self, element: ET.Element, index: int) -> None:
        """Mass and inertia of the draw; it never tilts, and might as a thick box."""
        body = self.spec.bodies[index]
        mass = float(self.params.density[index]) * body.area
        inertia = mass * body.gyration
        tilt = 0.5 * inertia + mass * HALF_THICKNESS**2 / 3.0
        center = np.zeros(2)
        if self.params.center_of_mass is not None:
            center = self.params.center_of_mass[index]
        ET.SubElement(
            element,
            "inertial",
            pos=numbers((*center, 0.0)),
            mass=repr(mass),
            diaginertia=numbers((tilt, tilt, inertia)),
        )

    def _ends(self, joint: Joint, name: str, turn_b: float) -> tuple[str, str]:
        """Sites at both anchors."""
        slots = getattr(self.params, joint.kind)
        ends = []
        for body, anchor, suffix, turn in (
            (joint.body_a, slots.anchor_a[joint.slot], "a", 0.0),
            (joint.body_b, slots.anchor_b[joint.slot], "b", turn_b),
        ):
            site = ET.SubElement(self.places[body], "site", name=f"{name}.{suffix}")
            site.set("pos", numbers((*anchor, 0.0)))
            if turn:
                site.set("euler", numbers((0.0, 0.0, turn)))
            ends.append(site.attrib["name"])
        return ends[0], ends[1]

    def _label(self, joint: Joint) -> str:
        """Names of both ends, and the slot, which is all that tells twins apart."""
        names = [
            "world" if body == WORLD else self.spec.names[body]
            for body in (joint.body_a, joint.body_b)
        ]
        return f"{names[0]}.{names[1]}.{joint.kind}{joint.slot}"

    def _add_loop(self, joint: Joint) -> None:
        """A pin or a weld that the tree has no room for."""
        name, turn = self._label(joint), 0.0
        tag = {"revolute": "connect", "weld": "weld"}[joint.kind]
        if joint.kind == "weld":
            assert self.params.weld is not None
            turn = float(self.params.weld.angle[joint.slot])
        else:
            probe = ET.Element("joint", name=name)
            drives = ET.Element("actuator")
            slots, slot = self.params.revolute, joint.slot
            add_joint_laws(probe, drives, slots, slot, self.time_step)
            if len(drives) or len(probe.attrib) > 1:
                raise ValueError(
                    f"{self.spec.source}: pin {name!r}: expected no friction, range or "
                    "motor, as it closes a loop, where MuJoCo has none, got some"
                )
        one, other = self._ends(joint, name, turn)
        self._add_equality(tag, name, site1=one, site2=other)
        self.notes.append(f"{name} closes a loop: a stiff equality")

    def _add_rod(self, rod: Joint, rest: dict[int, np.ndarray]) -> None:
        """A tendon of constant length; MuJoCo counts it from the reference."""
        name = self._label(rod)
        sites = self._ends(rod, name, 0.0)
        slots = getattr(self.params, rod.kind)
        points = []
        for body, anchors in (
            (rod.body_a, slots.anchor_a),
            (rod.body_b, slots.anchor_b),
        ):
            pose = rest[body]
            points.append(pose[:2] + turned(anchors[rod.slot], pose[2]))
        tendon = ET.SubElement(self.sections["tendon"], "spatial", name=name)
        for site in sites:
            ET.SubElement(tendon, "site", site=site)
        more = float(slots.length[rod.slot]) - math.dist(*points)
        curve = numbers((more, 0.0, 0.0, 0.0, 0.0))
        self._add_equality("tendon", name, tendon1=name, polycoef=curve)
        self.notes.append(f"{name}: a rod as a stiff equality")

    def _add_equality(self, tag: str, name: str, **attributes: str) -> None:
        equality = ET.SubElement(self.sections["equality"], tag, name=name)
        equality.attrib |= attributes
        equality.set("solref", numbers((2.0 * self.time_step, 1.0)))
        equality.set("solimp", "0.9999 0.9999 0.001")

    def _add_contacts(self) -> None:
        """Every pair that may touch, with what the two are like together."""
        bodies, touch = self.spec.bodies, self.params.surface
        if touch is None or not has_contact(bodies):
            return
        kinds = ("revolute", "distance", "prismatic", "weld")
        joined = {
            frozenset((joint.body_a, joint.body_b))
            for joint in active_joints(self.params, kinds)
        }
        for j, other in enumerate(bodies):
            for i, one in enumerate(bodies[:j]):
                is_group = one.group is not None and one.group == other.group
                is_fixed = one.is_static and other.is_static
                if is_group or is_fixed or frozenset((i, j)) in joined:
                    continue
                friction = math.sqrt(touch.friction[i] * touch.friction[j])
                bounce = float(max(touch.restitution[i], touch.restitution[j]))
                pair = ET.SubElement(self.sections["contact"], "pair")
                pair.attrib |= {"name": f"{one.name}.{other.name}"}
                pair.attrib |= {"geom1": one.name, "geom2": other.name}
                pair.attrib |= surface(friction, bounce, self.time_step)
                pair.set("friction", numbers((friction, friction, 0.005, 1e-4, 1e-4)))
        if len(self.sections["contact"]):
            self.notes.append("contact: a stiff spring and damper, restitution as well")

    def _add_start(self, holds: list[Hold]) -> None:
        """The scene's start as a key frame, in MuJoCo's order of joints."""
        order = {hold.body: hold for hold in holds}
        names = [each.get("name") for each in self.places[WORLD].iter("body")]
        own = [order[self.spec.index(name)] for name in names if name is not None]
        pose = self.spec.pose
        for body in self.spec.bodies:
            if body.pose is None:
                self.notes.append(f"{body.name}: no start in the scene: the origin")
        twist = np.stack([body.twist for body in self.spec.bodies])
        place, rate = start_coordinates(own, self.params, np.nan_to_num(pose), twist)
        if place:
            key = ET.SubElement(self.sections["keyframe"], "key", name="start")
            key.attrib |= {"qpos": numbers(place), "qvel": numbers(rate)}
