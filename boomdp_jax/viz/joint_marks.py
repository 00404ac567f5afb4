"""Pins, rods and wheels as points fixed in bodies, to be drawn wherever those are."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from boomdp_jax.physics.constraint_spec import JOINTS
from boomdp_jax.physics.params import WORLD, Params
from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.viz.style import BY_KIND, EDGE, WHEEL

WHEEL_SIZE = (0.4, 0.14)
"""Length and thickness of a drawn wheel, as shares of how far its body reaches."""


class Link(NamedTuple):
    """A joint between two bodies, or a body and the world."""

    kind: str
    """Of a joint."""
    body_a: int
    body_b: int
    """Partner; `WORLD` for the world."""
    anchor_a: Float[np.ndarray, "2"]
    """In the frame of body a [m]."""
    anchor_b: Float[np.ndarray, "2"]
    """In the frame of body b, or of the world [m]."""


class WheelMark(NamedTuple):
    """A wheel on a body."""

    body: int
    position: Float[np.ndarray, "2"]
    """In the frame of the body [m]."""
    heading: float
    """Direction of rolling in the frame of the body [rad]."""
    half_track: float
    """Half the distance of two wheels on the axle [m]; zero for a single one."""


class JointMarks(NamedTuple):
    """All that is drawn on top of the outlines."""

    links: list[Link]
    wheels: list[WheelMark]


def joint_marks(spec: SceneSpec, params: Params | None) -> JointMarks:
    """Collect the active pins, rods and wheels.

    Args:
        spec: the scene.
        params: one hypothesis; None: what the scene file says exists, as far as it
            says where.

    Returns:
        The marks.

    Raises:
        ValueError: params of other bodies, or a batch of them.
    """
    if params is None:
        return _known_marks(spec)
    if params.density.shape != (spec.num_bodies,):
        raise ValueError(
            f"params: expected one hypothesis about {spec.num_bodies} bodies, got "
            f"densities of shape {params.density.shape}"
        )
    links = []
    for kind in JOINTS:
        slots = getattr(params, kind)
        if slots is None:
            continue
        fields = (slots.body_a, slots.body_b, slots.anchor_a, slots.anchor_b)
        body_a, body_b, anchor_a, anchor_b = map(np.asarray, fields)
        links += [
            Link(kind, int(body_a[i]), int(body_b[i]), anchor_a[i], anchor_b[i])
            for i in np.flatnonzero(slots.active)
        ]
    wheel = params.wheel
    half_track = wheel.half_track
    tracks = np.zeros(wheel.active.shape) if half_track is None else half_track
    wheels = [
        WheelMark(
            int(body),
            np.asarray(wheel.position[body, slot]),
            float(wheel.heading[body, slot]),
            float(tracks[body, slot]),
        )
        for body, slot in np.argwhere(np.asarray(wheel.active))
    ]
    return JointMarks(links, wheels)


def draw_joint_marks(
    ax: Any, spec: SceneSpec, poses: Float[np.ndarray, "body 3"], marks: JointMarks
) -> None:
    """Draw pins, rods and wheels where the bodies are.

    Args:
        ax: a `matplotlib.axes.Axes`.
        spec: the scene.
        poses: where the bodies are [m, m, rad].
        marks: what to draw.
    """
    from matplotlib.patches import Polygon

    dot = {"marker": "o", "markersize": 7, "linestyle": "", "zorder": 5}
    for link in marks.links:
        colour = BY_KIND[link.kind]
        ends = np.stack(link_ends(link, poses))
        if link.kind in ("distance", "prismatic"):
            ax.plot(*ends.T, color=colour, linewidth=2, zorder=4)
        for end, body in zip(ends, (link.body_a, link.body_b), strict=True):
            if link.kind == "revolute" and body != WORLD:
                # An anchor outside its outline hangs on an arm, not on nothing.
                arm = np.stack([poses[body, :2], end])
                ax.plot(*arm.T, color=colour, linewidth=1, alpha=0.6, zorder=3)
            ax.plot(*end, markerfacecolor="white", markeredgecolor=colour, **dot)
    for wheel in marks.wheels:
        for corners in wheel_corners(wheel, spec):
            placed = to_world(corners, poses[wheel.body])
            ax.add_patch(
                Polygon(placed, closed=True, facecolor=WHEEL, edgecolor=EDGE, zorder=4)
            )
        axle = np.array([[0.0, -1.0], [0.0, 1.0]]) * wheel.half_track
        placed = to_world(_on_body(axle, wheel), poses[wheel.body])
        ax.plot(*placed.T, color=WHEEL, linewidth=1.5, zorder=3)


def link_ends(
    link: Link, poses: Float[np.ndarray, "*time body 3"]
) -> tuple[Float[np.ndarray, "*time 2"], Float[np.ndarray, "*time 2"]]:
    """Both anchors of a joint in the world.

    Args:
        link: the joint.
        poses: where the bodies are, at one instant or at many [m, m, rad].

    Returns:
        The anchors [m].
    """
    end_a = to_world(link.anchor_a, poses[..., link.body_a, :])
    if link.body_b == WORLD:
        return end_a, np.broadcast_to(link.anchor_b, end_a.shape)
    return end_a, to_world(link.anchor_b, poses[..., link.body_b, :])


def wheel_corners(
    wheel: WheelMark, spec: SceneSpec
) -> list[Float[np.ndarray, "corner 2"]]:
    """Outlines of the one or two wheels of a mark, in the frame of its body.

    Args:
        wheel: the mark.
        spec: the scene, for the size of the body.

    Returns:
        Four corners for each wheel [m].
    """
    signs = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    tyre = 0.5 * signs * WHEEL_SIZE * spec.bodies[wheel.body].reach
    sides = (-1.0, 1.0) if wheel.half_track > 0 else (0.0,)
    return [
        _on_body(tyre + np.array([0.0, side * wheel.half_track]), wheel)
        for side in sides
    ]


def to_world(
    points: Float[np.ndarray, "*point 2"], pose: Float[np.ndarray, "*time 3"]
) -> Float[np.ndarray, "*place 2"]:
    """Points of a body in the world, at one pose or at many.

    Args:
        points: in the frame of the body [m].
        pose: where the body is [m, m, rad]; leading axes come first in the result.

    Returns:
        The points in the world [m].
    """
    pose = pose.reshape(*pose.shape[:-1], *[1] * (points.ndim - 1), 3)
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = pose[..., 0] + cos * points[..., 0] - sin * points[..., 1]
    y = pose[..., 1] + sin * points[..., 0] + cos * points[..., 1]
    return np.stack([x, y], axis=-1)


def _on_body(points: np.ndarray, wheel: WheelMark) -> np.ndarray:
    """Points of a wheel, rolling along x, in the frame of its body."""
    return to_world(points, np.array([*wheel.position, wheel.heading]))


def _known_marks(spec: SceneSpec) -> JointMarks:
    """Marks of the constraints in a scene file whose places it gives."""
    links, wheels = [], []
    for each in spec.constraints:
        numbers = each.numbers
        if each.kind in JOINTS:
            anchors = numbers["anchor_a"], numbers["anchor_b"]
            if np.all(np.isfinite(anchors)):
                links.append(Link(each.kind, each.body_a, each.body_b, *anchors))
        elif each.kind == "wheel":
            place, heading = numbers["position"], float(numbers["heading"])
            if np.all(np.isfinite(place)) and np.isfinite(heading):
                wheels.append(WheelMark(each.body_a, place, heading, 0.0))
    return JointMarks(links, wheels)
