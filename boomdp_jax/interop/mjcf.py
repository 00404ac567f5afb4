"""The text of a MuJoCo world in which one planar object lives by a chosen set of laws.

MuJoCo's joints, actuators and contacts stand in for the constraints of a scene file.
They are its own laws, not ours: friction limits are a box where ours are an ellipse,
feet share the weight as statics has it, contacts creep.
"""

import dataclasses
import math
import xml.etree.ElementTree as ET
from typing import Literal

import numpy as np

from boomdp_jax.interop.mjcf_elements import numbers, velocity_force
from boomdp_jax.physics.params import Params, Wheel
from boomdp_jax.physics.scene_spec import STANDARD_GRAVITY, SceneSpec

FOOT_RADIUS = 0.01
"""Radius of a foot and of an axle in contact with the floor [m]."""

_HEIGHT = 0.03
"""Height of the centre of mass above the floor [m]: pushes shift load between feet."""

_LEAST_FRICTION = 1e-5
"""What MuJoCo takes for no friction; it refuses zero in a contact pair."""


@dataclasses.dataclass(frozen=True)
class RecordingLaws:
    """Which of MuJoCo's elements stand for a scene's constraints."""

    pin: Literal["hinge", "connect"] = "hinge"
    """A joint, which holds exactly, or a stiff equality constraint."""
    wheel: Literal["force", "contacts"] = "force"
    """Two body-fixed forces against velocity, each with its own limit, or a pair of
    contacts some way apart under a constant load."""
    ground: Literal["feet", "joints"] = "feet"
    """Contacts of the feet on a plane, or friction of the planar joints: force and
    torque limited on their own."""
    half_track: float = 0.1
    """Half the distance between the contacts of a wheel [m]."""
    time_step: float = 0.0005
    """MuJoCo's own time step [s]; a millisecond at most."""


def world_text(truth: SceneSpec, params: Params, laws: RecordingLaws) -> str:
    """Write the world of one object.

    The body is called `object` and its angle is the joint `theta`. Unless a hinge pins
    it, the joints `x` and `y` place its centre of mass.

    Args:
        truth: scene with one body, of which everything is known.
        params: its `params()`, of NumPy arrays.
        laws: which elements to use.

    Returns:
        A document in MuJoCo's XML format.
    """
    body = truth.bodies[0]
    mass = float(params.density[0]) * body.area
    inertia = mass * body.gyration
    has_floor = has_contacts(truth, params, laws)
    parts = _Parts()
    _add_joints(parts, truth, params, laws, mass)
    _add_wheel(parts, params, laws, mass)
    if _has_feet(truth, params, laws):
        _add_feet(parts, float(params.ground.dry[0, 0]), body.feet, body.foot_size)
    covariance = body.moments.covariance
    thick = (2 * _HEIGHT) ** 2 / 12.0
    tilts = mass * (covariance[1, 1] + thick), mass * (covariance[0, 0] + thick)
    gravity = (*truth.gravity, -truth.normal_gravity if has_floor else 0.0)
    integrator = "implicitfast" if has_floor or laws.pin == "connect" else "RK4"
    place = np.zeros(2)
    if params.revolute.active.any():
        place = params.revolute.anchor_b[0] - params.revolute.anchor_a[0]
    return f"""
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{laws.time_step}" gravity="{numbers(gravity)}" cone="elliptic"
    integrator="{integrator}" impratio="10" tolerance="1e-12" iterations="200"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" pos="0 0 {-_HEIGHT}"
      contype="0" conaffinity="0"/>
    <body name="object" pos="{numbers((*place, 0.0))}">
      {parts.joints}
      <inertial pos="0 0 0" mass="{mass}"
        diaginertia="{numbers((*tilts, inertia))}"/>
      {parts.children}
    </body>
  </worldbody>
  <contact>{parts.contacts}</contact>
  <equality>{parts.equalities}</equality>
  <actuator>{parts.actuators}</actuator>
</mujoco>
"""


def has_contacts(truth: SceneSpec, params: Params, laws: RecordingLaws) -> bool:
    """Whether anything rests on the floor and needs time to settle.

    Args:
        truth: scene with one body.
        params: numbers of the object.
        laws: which elements stand for its constraints.

    Returns:
        True if there are feet or a wheel made of contacts.
    """
    has_axle = params.wheel.active.any() and laws.wheel == "contacts"
    return bool(has_axle) or _has_feet(truth, params, laws)


def _has_feet(truth: SceneSpec, params: Params, laws: RecordingLaws) -> bool:
    """Feet need a load and a finite friction coefficient."""
    return bool(
        params.ground.active.any()
        and np.isfinite(params.ground.dry[0, 0])
        and laws.ground == "feet"
        and truth.normal_gravity > 0
    )


@dataclasses.dataclass
class _Parts:
    """Pieces of the document, each a sequence of elements."""

    joints: str = ""
    children: str = ""
    contacts: str = ""
    equalities: str = ""
    actuators: str = ""


def _add_joints(
    parts: _Parts, truth: SceneSpec, params: Params, laws: RecordingLaws, mass: float
) -> None:
    """Planar joints with the pin's friction and, if it is theirs, the ground's."""
    body = truth.bodies[0]
    slide, turn = _Friction(), _Friction()
    revolute, ground = params.revolute, params.ground
    is_pinned = bool(revolute.active.any())
    has_hinge = is_pinned and laws.pin == "hinge"
    centre = revolute.anchor_a[0] if has_hinge else np.zeros(2)
    if is_pinned:
        turn.add(float(revolute.viscous[0]), float(revolute.dry[0]))
    if ground.active.any() and not _has_feet(truth, params, laws):
        arms = np.hypot(np.hypot(*(body.feet - centre).T), body.foot_size)
        limit = float(ground.dry[0, 0])
        limit = limit if math.isinf(limit) else limit * mass * truth.normal_gravity
        viscous = float(ground.viscous[0, 0])
        slide.add(viscous, limit)
        if math.isinf(limit):
            turn.add(viscous * float(body.foot_load @ arms**2), limit)
        else:
            turn.add(0.0, limit * float(body.foot_load @ arms))
    theta = f'<joint name="theta" type="hinge" axis="0 0 1" {turn.text()}'
    if has_hinge:
        parts.joints += f'{theta} pos="{numbers((*centre, 0.0))}"/>'
    else:
        for name, axis in (("x", "1 0 0"), ("y", "0 1 0")):
            parts.joints += (
                f'<joint name="{name}" type="slide" axis="{axis}" {slide.text()}/>'
            )
        parts.joints += f"{theta}/>"
    if is_pinned and not has_hinge:
        at = numbers((*revolute.anchor_a[0], 0.0))
        parts.equalities += (
            f'<connect body1="object" anchor="{at}" solref="{2 * laws.time_step} 1" '
            'solimp="0.9999 0.9999 0.001"/>'
        )


@dataclasses.dataclass
class _Friction:
    """Friction of one joint: a finite limit counts as dry, else it is viscous."""

    damping: float = 0.0
    loss: float = 0.0

    def add(self, viscous: float, limit: float) -> None:
        if math.isinf(limit):
            self.damping += viscous
        else:
            self.loss += limit

    def text(self) -> str:
        return (
            f'damping="{self.damping}" frictionloss="{self.loss}" '
            'solreffriction="0.002 1" solimpfriction="0.99 0.999 0.001"'
        )


def _add_wheel(parts: _Parts, params: Params, laws: RecordingLaws, mass: float) -> None:
    """A wheel: forces on a site of the body, or an axle that rests on the floor."""
    wheel = params.wheel
    if not wheel.active.any():
        return
    x, y = wheel.position[0, 0]
    heading = float(wheel.heading[0, 0])
    parts.children += f'<site name="wheel" pos="{x} {y} 0" euler="0 0 {heading}"/>'
    for axis in range(2):
        viscous, limit = (float(a[0, 0, axis]) for a in (wheel.viscous, wheel.dry))
        is_contact = laws.wheel == "contacts" and math.isfinite(limit)
        if viscous == 0.0 or limit == 0.0 or is_contact:
            continue
        gear = ("1 0 0 0 0 0", "0 1 0 0 0 0")[axis]
        law = velocity_force(viscous, limit, site="wheel", gear=gear)
        parts.actuators += ET.tostring(ET.Element("general", law), "unicode")
    if laws.wheel == "contacts":
        _add_axle(parts, wheel, laws, mass)


def _add_axle(parts: _Parts, wheel: Wheel, laws: RecordingLaws, mass: float) -> None:
    """A capsule along the axle, pressed on the floor by half the object's weight.

    MuJoCo turns the contacts of a capsule with its axis, so that their first direction
    is along the axle and their second one that of rolling.
    """
    load = 0.5 * mass * STANDARD_GRAVITY
    limits = wheel.dry[0, 0]
    rolling, lateral = (
        max(limit / load if math.isfinite(limit) else 0.0, _LEAST_FRICTION)
        for limit in (float(limits[0]), float(limits[1]))
    )
    x, y = wheel.position[0, 0]
    heading = float(wheel.heading[0, 0])
    dx, dy = -laws.half_track * math.sin(heading), laws.half_track * math.cos(heading)
    parts.children += f"""
      <body name="axle" pos="{x} {y} {FOOT_RADIUS - _HEIGHT}">
        <joint name="press" type="slide" axis="0 0 1" armature="{0.1 * mass}"/>
        <inertial pos="0 0 0" mass="{1e-6 * mass}"
          diaginertia="{numbers([1e-8 * mass] * 3)}"/>
        <geom name="axle" type="capsule" size="{FOOT_RADIUS}"
          fromto="{-dx} {-dy} 0 {dx} {dy} 0" contype="0" conaffinity="0"/>
      </body>"""
    parts.actuators += (
        f'<general joint="press" gainprm="0" biastype="affine" biasprm="{-load} 0 0"/>'
    )
    parts.contacts += _pair("axle", (lateral, rolling))


def _add_feet(
    parts: _Parts, friction: float, feet: np.ndarray, sizes: np.ndarray
) -> None:
    """Let the object heave and tilt, and give it feet that rub on the floor."""
    parts.joints += '<joint name="heave" type="slide" axis="0 0 1"/>'
    for name, axis in (("roll", "1 0 0"), ("pitch", "0 1 0")):
        parts.joints += f'<joint name="{name}" type="hinge" axis="{axis}"/>'
    for i, ((x, y), size) in enumerate(zip(feet, sizes, strict=True)):
        parts.children += (
            f'<geom name="foot{i}" type="sphere" size="{FOOT_RADIUS}" mass="0" '
            f'pos="{x} {y} {FOOT_RADIUS - _HEIGHT}" contype="0" conaffinity="0"/>'
        )
        parts.contacts += _pair(f"foot{i}", (friction, friction), friction * size)


def _pair(geom: str, friction: tuple[float, float], torsion: float = 0.0) -> str:
    """Contact of a geom with the floor, with a coefficient for each tangent.

    And one against spin [m], all of which limit each other (`cone="elliptic"`).
    """
    return (
        f'<pair geom1="floor" geom2="{geom}" condim="{4 if torsion > 0.0 else 3}" '
        f'solref="0.02 1" solimp="0.98 0.99 0.001" '
        f'friction="{friction[0]} {friction[1]} {torsion or 1e-4} 0.0001 0.0001"/>'
    )
