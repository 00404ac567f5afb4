"""Two chambers with a door between them, and one thing; all rooms are one program."""

import numpy as np

from boomdp_jax.envs import Room, Thing

DOOR = (3.1, 2.0)
"""Middle of the door, which is 1 m wide and goes through a wall of 0.2 m."""
START, GOAL = (1.0, 2.0), (5.2, 2.0)
_WALLS = (
    (-0.2, 0.0, 0.0, 4.0),
    (-0.2, -0.2, 6.2, 0.0),
    (6.0, 0.0, 6.2, 4.0),
    (-0.2, 4.0, 6.2, 4.2),
    (3.0, 0.0, 3.2, 1.5),
    (3.0, 2.5, 3.2, 4.0),
)


def thing(**changes) -> Thing:
    """A light box in a corner, out of the way."""
    box = Thing(
        name="box",
        label="chair",
        outline=(0.3, 0.25),
        pose=(5.5, 3.5, 0.0),
        kind="free",
        density=40.0,
        friction=0.3,
    )
    return box._replace(**changes)


def room(one: Thing | None = None, **changes) -> Room:
    """The chambers, with the box unless another thing is given."""
    things = (thing() if one is None else one,)
    return Room(things, _WALLS, START, GOAL)._replace(**changes)


def poses_of(one: Room) -> np.ndarray:
    """Where its things are."""
    return np.array([thing.pose for thing in one.things])
