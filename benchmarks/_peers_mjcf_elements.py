"""The elements of a MuJoCo world that stand for parts of a planar scene, as text.

Shapes and their surfaces, walls, feet, pins' anchors and wheels; `_peers_mjcf` puts
them together and says what they mean.
"""

import math

import numpy as np
from _peers_program import NotExpressibleError

from boomdp_jax.physics.body_spec import BodySpec
from boomdp_jax.physics.scene_spec import SceneSpec

HALF_THICKNESS = 0.1
"""Half the extent of boxes across the plane [m]."""

FOOT_RADIUS, HEIGHT = 0.01, 0.03
"""Radius of a foot, and height of a centre of mass above the floor [m]."""

BOUNCE_STEPS = 6
"""Steps that a bouncing contact lasts: fewer are integrated badly."""


def geom(body: BodySpec, dt: float, origin: np.ndarray) -> str:
    """A body's shape.

    Args:
        body: the body.
        dt: time step of the scene [s].
        origin: where its MuJoCo frame is, from its centre of mass [m].

    Returns:
        One element.
    """
    if body.friction is None:
        # Nothing but a mark, without which Brax does not read a world.
        return f'<geom size="{FOOT_RADIUS}" mass="0" contype="0" conaffinity="0"/>'
    surface = f'pos="{-origin[0]} {-origin[1]} 0" {_surface(body, dt)}'
    if body.kind == "circle":
        return f'<geom type="sphere" mass="0" size="{body.radius}" {surface}/>'
    if body.kind != "box":
        raise NotExpressibleError("polygons need a mesh")
    x, y = body.outline.max(axis=0)
    return f'<geom type="box" mass="0" size="{x} {y} {HALF_THICKNESS}" {surface}/>'


def _surface(body: BodySpec, dt: float) -> str:
    """Friction, and the spring and damper that give back a share of the speed."""
    friction, restitution = float(body.friction), float(body.restitution or 0.0)
    text = f'condim="{3 if friction else 1}" friction="{friction} 0.005 0.0001"'
    if restitution == 0.0:
        return text
    logarithm = -math.log(restitution)
    damping = logarithm / math.hypot(logarithm, math.pi)
    rate = math.pi / (BOUNCE_STEPS * dt * math.sqrt(1.0 - damping**2))
    spring = f"{-(rate**2)} {-2.0 * damping * rate}"
    return f'{text} solref="{spring}" solimp="0.99 0.99 0.001"'


def planes(spec: SceneSpec) -> str:
    """Static boxes as half-spaces, each by the face that looks at the bodies most."""
    moving = [body.pose[:2] for body in spec.bodies if not body.is_static]
    text = ""
    for body in spec.bodies:
        if not body.is_static or body.friction is None:
            continue
        if body.kind != "box":
            raise NotExpressibleError("a static body that is no box")
        vertices = turned(body.vertices, np.full(len(body.vertices), body.pose[2]))
        vertices = vertices + body.pose[:2]
        edge = np.roll(vertices, -1, axis=0) - vertices
        normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        ahead = np.sum((np.mean(moving, axis=0) - vertices) * normal, axis=1)
        face = int(np.argmax(ahead))
        (x, y), (nx, ny) = vertices[face], normal[face]
        text += (
            f'<geom type="plane" size="0 0 1" pos="{x} {y} 0" zaxis="{nx} {ny} 0" '
            f"{_surface(body, spec.dt)}/>"
        )
    return text


def floor_plane() -> str:
    """The floor of a scene seen from above, with no friction but that of the feet."""
    return (
        f'<geom type="plane" size="0 0 1" pos="0 0 {-HEIGHT}" condim="3" '
        'friction="0 0 0.0001"/>'
    )


def feet(body: BodySpec, friction: float) -> str:
    """Spheres that rest on the floor."""
    return "".join(
        f'<geom type="sphere" size="{FOOT_RADIUS}" mass="0" condim="4" '
        f'friction="{friction} {friction * size} 0.0001" '
        f'pos="{x} {y} {FOOT_RADIUS - HEIGHT}"/>'
        for (x, y), size in zip(body.feet, body.foot_size, strict=True)
    )


def sites_of_pins(pins, index: int, end: str, origin: np.ndarray) -> str:
    """Anchors of pins on one body, or on the world."""
    text = ""
    for i, joint in enumerate(pins):
        if (joint.body_a if end == "a" else joint.body_b) == index:
            x, y = joint.numbers[f"anchor_{end}"] - origin
            text += f'<site name="{end}{i}" pos="{x} {y} 0"/>'
    return text


def wheel_actuators(index: int, wheel) -> str:
    """Body-fixed forces against velocity, along a wheel and across it."""
    text = ""
    for axis in range(2):
        viscous = float(wheel.numbers["viscous"][axis])
        limit = float(wheel.numbers["dry"][axis])
        gear = ["0"] * 6
        gear[axis] = "1"
        bound = ""
        if math.isfinite(limit):
            bound = f'forcelimited="true" forcerange="{-limit} {limit}"'
        text += (
            f'<general site="wheel{index}" gear="{" ".join(gear)}" gainprm="0" '
            f'biastype="affine" biasprm="0 0 {-viscous}" {bound}/>'
        )
    return text


def turned(point: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Points turned by angles, leading axes alike."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = point[..., 0], point[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
