"""A room in which furniture is in a robot's way: what is there, and what it truly is.

Things are boxes and discs of a catalogue (`LOOKS`), each of a hidden kind: `free` ones
slide, `heavy` ones hardly do, ones on `wheels` roll along a line and resist across it,
`revolute` ones turn about a pin, `fixed` ones do not move at all. How heavy a thing
looks is told with its label, as people see that a couch is no chair; its kind is not.
"""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from boomdp_jax.core.arrays import on_device
from boomdp_jax.physics.params import Params, empty_params
from boomdp_jax.physics.scene_spec import (
    STANDARD_GRAVITY,
    SceneSpec,
    scene_spec_from_dict,
)

KINDS = ("free", "heavy", "wheels", "revolute", "fixed")
"""What a thing may be."""
ROBOT = "robot"
"""Name of the robot's body, which comes after all things and before the walls."""
TIME_STEP = 0.1
"""Of the world [s]."""
_SURFACE = {"friction": 0.2, "restitution": 0.0}
NUM_SUBSTEPS = 6
"""Of a step of the world, so that fast bodies do not pass through walls."""
# From slip to stick, as in scene files: speed at which a dry limit is reached [m/s].
_KNEE_SPEED = 0.02
# Of a pin: torque over weight and reach of the thing. Of a wheel: rolling and lateral
# limits over the thing's weight.
_PIN_FRICTION = 0.02
_WHEEL_LIMIT = np.array([0.03, 0.6])


NUM_PINS = 2
"""Pins that there is room for in every room, so that those of one size are one program;
a room with more of them has a program of its own."""


class Look(NamedTuple):
    """What is seen of things with one label."""

    density: float
    """How heavy such things usually are [kg/m²], a median."""
    spread: float
    """Standard deviation of its logarithm."""


LOOKS: Mapping[str, Look] = MappingProxyType(
    {
        "chair": Look(20.0, 0.4),
        "table": Look(15.0, 0.4),
        "couch": Look(30.0, 0.4),
        "shelf": Look(50.0, 0.5),
        "trolley": Look(25.0, 0.4),
    }
)
"""By label; agents are told the same."""


class Thing(NamedTuple):
    """One piece of furniture, with what is true of it."""

    name: str
    label: str
    outline: tuple[float, ...]
    """Half extents of a box [m], or the radius of a disc alone."""
    pose: tuple[float, float, float]
    """Of its middle, which is its centre of mass [m, m, rad]."""
    kind: str
    density: float
    """[kg/m²]"""
    friction: float
    """Coefficient of the floor; not of wheels."""
    axle: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of `wheels`: place and direction of rolling, in its own frame [m, m, rad]."""
    pin: tuple[float, float] = (0.0, 0.0)
    """Of `revolute`: in its own frame [m]."""

    @property
    def shape(self) -> dict:
        """Outline, as in a scene file."""
        if len(self.outline) == 1:
            return {"type": "circle", "radius": self.outline[0]}
        return {"type": "box", "half_extents": list(self.outline)}

    @property
    def area(self) -> float:
        """Of the outline [m²]."""
        if len(self.outline) == 1:
            return math.pi * self.outline[0] ** 2
        return 4.0 * self.outline[0] * self.outline[1]

    @property
    def mass(self) -> float:
        """Of the thing [kg]."""
        return self.density * self.area

    @property
    def reach(self) -> float:
        """Farthest point of the outline from its middle [m]."""
        return math.hypot(*self.outline)


class Robot(NamedTuple):
    """A disc that drives in any direction."""

    radius: float = 0.35
    """[m]"""
    mass: float = 60.0
    """[kg]"""
    force: float = 250.0
    """Most that it drives with, in any direction [N]."""
    torque: float = 60.0
    """Likewise [N m]."""
    speed: float = 0.8
    """At which it drives when nothing is held [m/s]."""
    grip: float = 400.0
    """Force from which its grasp slips off [N]."""


class Room(NamedTuple):
    """All of a task, the truth included."""

    things: tuple[Thing, ...]
    walls: tuple[tuple[float, float, float, float], ...]
    """Least x and y and greatest x and y [m]; the first four go round the room."""
    start: tuple[float, float]
    """Of the robot's middle [m]."""
    goal: tuple[float, float]
    robot: Robot = Robot()

    @property
    def bounds(self) -> Float[np.ndarray, "2 2"]:
        """Least and greatest x and y inside the outer walls [m]."""
        left, bottom, right, top = np.array(self.walls[:4])
        return np.array([[left[2], bottom[3]], [right[0], top[1]]])

    @property
    def num_things(self) -> int:
        """Bodies that an agent may move; the first ones of the scene."""
        return len(self.things)


def room_scene(room: Room) -> SceneSpec:
    """Bodies of the whole room: things, robot, walls; for the world and for pictures.

    Args:
        room: the room.

    Returns:
        Its scene; what holds things is in `room_params`.
    """
    bodies = [
        {
            "name": thing.name,
            "label": thing.label,
            "pose": list(thing.pose),
            "shape": thing.shape,
            "density": thing.density,
            "static": thing.kind == "fixed",
            "contact": _SURFACE,
        }
        for thing in room.things
    ]
    robot = room.robot
    bodies.append(
        {
            "name": ROBOT,
            "pose": [*room.start, 0.0],
            "shape": {"type": "circle", "radius": robot.radius},
            "density": robot.mass / (math.pi * robot.radius**2),
            "contact": _SURFACE,
        }
    )
    for index, (x0, y0, x1, y1) in enumerate(room.walls):
        half = [0.5 * (x1 - x0), 0.5 * (y1 - y0)]
        bodies.append(
            {
                "name": f"wall {index}",
                "static": True,
                "pose": [x0 + half[0], y0 + half[1], 0.0],
                "shape": {"type": "box", "half_extents": half},
                "contact": _SURFACE,
            }
        )
    return scene_spec_from_dict(
        {"schema": "planar-scene-1", "dt": TIME_STEP, "bodies": bodies}, "room"
    )


def room_params(room: Room, spec: SceneSpec) -> Params:
    """What is true of a room; slots are the same for all rooms of as many bodies.

    Each thing has a wheel and friction of the floor, either of which is there or not;
    `NUM_PINS` pins (more, if there are) hold some; the one weld is the robot's grasp,
    of nothing. What is fixed is a static body.

    Args:
        room: the room.
        spec: its `room_scene`.
    """
    num, num_bodies = room.num_things, spec.num_bodies
    pinned = [index for index, t in enumerate(room.things) if t.kind == "revolute"]
    num_pins = max(NUM_PINS, len(pinned))
    params = empty_params(
        num_bodies,
        num_revolute=num_pins,
        num_wheel=1,
        num_ground=1,
        num_weld=1,
        friction=_SURFACE["friction"],
        restitution=_SURFACE["restitution"],
    )
    density = np.ones(num_bodies)
    position, limit = np.zeros((num_bodies, 1, 2)), np.zeros((num_bodies, 1, 2))
    heading, ground = np.zeros((num_bodies, 1)), np.zeros((num_bodies, 1))
    rolls, slides = np.zeros((num_bodies, 1)), np.zeros((num_bodies, 1))
    for index, thing in enumerate(room.things):
        density[index] = thing.density
        position[index, 0], heading[index, 0] = thing.axle[:2], thing.axle[2]
        limit[index, 0] = _WHEEL_LIMIT * thing.mass * STANDARD_GRAVITY
        ground[index, 0] = thing.friction
        rolls[index] = thing.kind == "wheels"
        slides[index] = thing.kind in ("free", "heavy")
    density[num] = room.robot.mass / (math.pi * room.robot.radius**2)
    weight = STANDARD_GRAVITY * density * np.asarray(spec.scene.area, float)
    pin, at, dry = np.zeros((num_pins, 2)), np.zeros((num_pins, 2)), np.zeros(num_pins)
    body = np.zeros(num_pins)
    for slot, index in enumerate(pinned):
        thing = room.things[index]
        body[slot], pin[slot] = index, thing.pin
        cos, sin = math.cos(thing.pose[2]), math.sin(thing.pose[2])
        at[slot] = thing.pose[:2] + np.array([[cos, -sin], [sin, cos]]) @ thing.pin
        dry[slot] = _PIN_FRICTION * thing.mass * STANDARD_GRAVITY * thing.reach
    return Params(
        density=on_device(density),
        revolute=type(params.revolute)(
            active=on_device(np.arange(num_pins) < len(pinned), bool),
            body_a=on_device(body, np.dtype(np.int32)),
            body_b=params.revolute.body_b,
            anchor_a=on_device(pin),
            anchor_b=on_device(at),
            viscous=on_device(dry / _KNEE_SPEED),
            dry=on_device(dry),
        ),
        distance=params.distance,
        wheel=type(params.wheel)(
            active=on_device(rolls, bool),
            position=on_device(position),
            heading=on_device(heading),
            viscous=on_device(limit / _KNEE_SPEED),
            dry=on_device(limit),
        ),
        ground=type(params.ground)(
            active=on_device(slides, bool),
            dry=on_device(ground),
            viscous=on_device(ground * weight[:, None] / _KNEE_SPEED),
        ),
        surface=params.surface,
        weld=params.weld,
    )


def thing_scene(thing: Thing) -> SceneSpec:
    """What an agent is told of a thing: outline, label, and what may hold it.

    Args:
        thing: which; nothing is told of its kind or numbers.
    """
    look = LOOKS[thing.label]
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": TIME_STEP,
            "bodies": [
                {
                    "name": thing.name,
                    "label": thing.label,
                    "pose": list(thing.pose),
                    "shape": thing.shape,
                }
            ],
            "unknown": {"revolute": 1, "wheel": 1, "ground": 1},
            "prior": {
                # Some are heavier than they look: a shelf may be full of books.
                "density": {"center": look.density, "spread": look.spread + 0.5},
                "probability": {"revolute": 0.2, "wheel": 0.3, "ground": 0.7},
            },
        },
        thing.name,
    )
