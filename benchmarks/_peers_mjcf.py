"""A planar scene as a MuJoCo world: for MuJoCo itself, MJX and Brax.

Bodies have two slides and a hinge, or, where a pin holds them, only that pin's hinge,
at which their frame is then ("hinge"; a chain is a tree); as "connect", pins are
equality constraints between free bodies, of default softness (stiffer ones were worse).
MuJoCo has no plane world: boxes are 0.2 m thick, and static ones are half-spaces
(`plane`) that show their nearest face to the bodies, as a user would build a floor or a
wall. A wheel is a pair of body-fixed velocity actuators with force limits (a box where
ours is an ellipse), the floor of a scene seen from above is a real one, on which feet
stand. MuJoCo has no coefficient of restitution; a spring and damper of `BOUNCE_STEPS`
steps stand for it.
"""

import dataclasses
from typing import Literal

import numpy as np
from _peers_mjcf_elements import (
    HEIGHT,
    feet,
    floor_plane,
    geom,
    planes,
    sites_of_pins,
    turned,
    wheel_actuators,
)
from _peers_program import NotExpressibleError

from boomdp_jax.physics.params import WORLD
from boomdp_jax.physics.scene_spec import SceneSpec

MAX_CONTACTS, MAX_PAIRS = 120, 30
"""What MJX's collision driver, which Brax uses too, may keep of each sort of pair."""

BRAX_STIFFNESS = 20000
"""Of the joints of Brax's spring pipeline [N/m]: that of its half-cheetah."""


@dataclasses.dataclass(frozen=True)
class Link:
    """How one moving body hangs in the tree, and where its coordinates start."""

    body: int
    address: int
    parent: int = WORLD
    anchor: np.ndarray | None = None
    """Hinge in the body's frame; None: slides and a hinge at the centre of mass."""
    parent_anchor: np.ndarray | None = None


@dataclasses.dataclass(frozen=True)
class World:
    """The document, and the meaning of its coordinates."""

    text: str
    links: tuple[Link, ...]
    num_coordinates: int
    spec: SceneSpec

    def to_joints(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joint positions and velocities from states `[..., body, 6]`."""
        shape = (*state.shape[:-2], self.num_coordinates)
        position, velocity = np.zeros(shape), np.zeros(shape)
        for link in self.links:
            own = state[..., link.body, :]
            if link.anchor is None:
                at = slice(link.address, link.address + 3)
                position[..., at], velocity[..., at] = own[..., :3], own[..., 3:]
                continue
            turn, spin = own[..., 2], own[..., 5]
            if link.parent != WORLD:
                turn = turn - state[..., link.parent, 2]
                spin = spin - state[..., link.parent, 5]
            position[..., link.address], velocity[..., link.address] = turn, spin
        return position, velocity

    def to_states(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """States `[..., body, 6]` from joint positions and velocities."""
        state = np.zeros((*position.shape[:-1], self.spec.num_bodies, 6))
        for i, body in enumerate(self.spec.bodies):
            if body.is_static:
                state[..., i, :3] = body.pose
        for link in self.links:
            own = state[..., link.body, :]
            if link.anchor is None:
                at = slice(link.address, link.address + 3)
                own[..., :3], own[..., 3:] = position[..., at], velocity[..., at]
                continue
            own[..., 2] = position[..., link.address]
            own[..., 5] = velocity[..., link.address]
            own[..., :2] = link.parent_anchor
            if link.parent != WORLD:
                parent = state[..., link.parent, :]
                arm = turned(link.parent_anchor, parent[..., 2])
                own[..., 2] += parent[..., 2]
                own[..., 5] += parent[..., 5]
                own[..., :2] = parent[..., :2] + arm
                own[..., 3:5] = parent[..., 3:5] + _swept(arm, parent[..., 5])
            arm = turned(link.anchor, own[..., 2])
            own[..., :2] -= arm
            own[..., 3:5] -= _swept(arm, own[..., 5])
        return state


def mujoco_world(
    spec: SceneSpec,
    *,
    pin: Literal["hinge", "connect"] = "hinge",
    integrator: str = "implicitfast",
    num_substeps: int = 1,
) -> World:
    """Write a scene.

    Args:
        spec: the scene, fully known.
        pin: what stands for revolute joints.
        integrator: MuJoCo's name of it.
        num_substeps: steps of MuJoCo in one of the scene.

    Returns:
        The world.

    Raises:
        NotExpressibleError: MuJoCo has nothing for a part of the scene.
    """
    grounded = {c.body_a: c for c in spec.constraints if c.kind == "ground"}
    pins = [c for c in spec.constraints if c.kind == "revolute"]
    wheels = [c for c in spec.constraints if c.kind == "wheel"]
    if pin == "connect" and not pins:
        raise NotExpressibleError("no pins here: the same as with hinges")
    for constraint in spec.constraints:
        if constraint.kind == "distance":
            raise NotExpressibleError("no rod between anchors")
    hinges = {}
    if pin == "hinge":
        hinges = {(c.body_a if c.body_b == WORLD else c.body_b): c for c in pins}
        if len(hinges) < len(pins):
            raise NotExpressibleError("pins form a loop, or a body hangs on two")
        if any({c.body_a, c.body_b} & grounded.keys() for c in pins):
            raise NotExpressibleError("a pinned body with feet: equalities only")
    links: list[Link] = []
    bodies = ""
    num = 0
    for i, body in enumerate(spec.bodies):
        if body.is_static or i in hinges:
            continue
        text, num = _body(spec, i, hinges, grounded, wheels, links, num)
        bodies += text
    for i, joint in hinges.items():
        if joint.body_b == WORLD:
            text, num = _body(spec, i, hinges, grounded, wheels, links, num)
            bodies += text
    actuators = "".join(wheel_actuators(i, wheel) for i, wheel in enumerate(wheels))
    equalities, sites = "", ""
    if pin == "connect":
        equalities = "".join(
            f'<connect site1="a{i}" site2="b{i}"/>' for i in range(len(pins))
        )
        sites = sites_of_pins(pins, WORLD, "b", np.zeros(2))
    down = -spec.normal_gravity if grounded else 0.0
    cone = 'cone="elliptic" impratio="10"' if grounded else ""
    floor = floor_plane() if grounded else ""
    text = f"""
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{spec.dt / num_substeps}" integrator="{integrator}" {cone}
    gravity="{spec.gravity[0]} {spec.gravity[1]} {down}"/>
  <worldbody>{floor}{sites}{planes(spec)}{bodies}</worldbody>
  <equality>{equalities}</equality>
  <actuator>{actuators}</actuator>
  <custom>
    <numeric name="max_contact_points" data="{MAX_CONTACTS}"/>
    <numeric name="max_geom_pairs" data="{MAX_PAIRS}"/>
    <numeric name="constraint_stiffness" data="{BRAX_STIFFNESS}"/>
  </custom>
</mujoco>
"""
    return World(text, tuple(links), num, spec)


def _body(spec, index, hinges, grounded, wheels, links, address) -> tuple[str, int]:
    """One body with all that hangs on it, and the next free coordinate."""
    body = spec.bodies[index]
    mass = body.density * body.area
    inertia = mass * body.gyration
    joint = hinges.get(index)
    place = origin = np.zeros(2)
    if joint is None:
        links.append(Link(index, address))
        joints = (
            '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>'
            '<joint type="hinge" axis="0 0 1"/>'
        )
        address += 3
    else:
        numbers = joint.numbers
        parent, anchor, parent_anchor = (
            (WORLD, numbers["anchor_a"], numbers["anchor_b"])
            if joint.body_b == WORLD
            else (joint.body_a, numbers["anchor_b"], numbers["anchor_a"])
        )
        links.append(Link(index, address, parent, anchor, parent_anchor))
        place, origin = parent_anchor - _origin(links, parent), anchor
        damping = float(numbers["viscous"])
        joints = f'<joint type="hinge" axis="0 0 1" damping="{damping}"/>'
        address += 1
    content = geom(body, spec.dt, origin)
    if index in grounded:
        joints += '<joint type="slide" axis="0 0 1"/>'
        joints += '<joint type="hinge" axis="1 0 0"/><joint type="hinge" axis="0 1 0"/>'
        content += feet(body, float(grounded[index].numbers["dry"]))
        address += 3
    for i, wheel in enumerate(wheels):
        if wheel.body_a == index:
            x, y = wheel.numbers["position"] - origin
            heading = float(wheel.numbers["heading"])
            content += f'<site name="wheel{i}" pos="{x} {y} 0" euler="0 0 {heading}"/>'
    pins = [c for c in spec.constraints if c.kind == "revolute"]
    for end in "ab":
        content += sites_of_pins(pins, index, end, origin)
    for child, other in hinges.items():
        if other.body_b == child and other.body_a == index:
            text, address = _body(spec, child, hinges, grounded, wheels, links, address)
            content += text
    tilt = mass * HEIGHT**2 + 0.5 * inertia
    text = f"""
    <body name="body{index}" pos="{place[0]} {place[1]} 0">{joints}
      <inertial pos="{-origin[0]} {-origin[1]} 0" mass="{mass}"
        diaginertia="{tilt} {tilt} {inertia}"/>
      {content}
    </body>"""
    return text, address


def _origin(links: list[Link], body: int) -> np.ndarray:
    """Where a body's MuJoCo frame is, from its centre of mass."""
    for link in links:
        if link.body == body and link.anchor is not None:
            return link.anchor
    return np.zeros(2)


def _swept(arm: np.ndarray, spin: np.ndarray) -> np.ndarray:
    return np.stack([-spin * arm[..., 1], spin * arm[..., 0]], axis=-1)
