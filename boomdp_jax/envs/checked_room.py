"""Whether what somebody wrote is a room: sizes, names, the robot in nothing's way.

Things may overlap each other, as contact takes them apart.
"""

import math

import numpy as np

from boomdp_jax.envs.free_space import SPACING, distance_to
from boomdp_jax.envs.namo_room import KINDS, LOOKS, ROBOT, Room

_ROUNDING = 1e-9
_SLACK = 0.5 * SPACING
"""By which a thing may overlap the robot [m]: of rooms that are drawn, only the middle
of the cell that the robot is in was looked at."""


def check_room(room: Room) -> Room:
    """Refuse a room that is none.

    Args:
        room: what somebody wrote.

    Returns:
        The same.

    Raises:
        ValueError: which thing or wall or part of the robot, which field, what was
            expected and what is there.
    """
    if len(room.walls) < 4:
        raise ValueError(
            f"walls: expected four round the room at least, got {len(room.walls)}"
        )
    for index, (x0, y0, x1, y1) in enumerate(room.walls):
        if not (x1 > x0 and y1 > y0):
            raise ValueError(
                f"walls[{index}]: expected greatest x and y above the least, got "
                f"{(x0, y0, x1, y1)}"
            )
    for thing in room.things:
        where = f"thing {thing.name!r}"
        if thing.kind not in KINDS:
            raise ValueError(
                f"{where}: kind: expected one of {', '.join(KINDS)}; got {thing.kind!r}"
            )
        if thing.label not in LOOKS:
            raise ValueError(
                f"{where}: label: expected one of {', '.join(LOOKS)}; got "
                f"{thing.label!r}"
            )
        sizes = thing.outline
        if len(sizes) not in (1, 2) or not all(0 < size < math.inf for size in sizes):
            raise ValueError(
                f"{where}: outline: expected a radius or two half extents, positive, "
                f"got {sizes}"
            )
        for field in ("pose", "axle", "pin"):
            numbers = getattr(thing, field)
            if not all(map(math.isfinite, numbers)):
                raise ValueError(
                    f"{where}: {field}: expected finite numbers, got {numbers}"
                )
        for field in ("density", "friction"):
            if not 0 < getattr(thing, field) < math.inf:
                raise ValueError(
                    f"{where}: {field}: expected a positive number, got "
                    f"{getattr(thing, field)}"
                )
    for field, number in room.robot._asdict().items():
        if not 0 < number < math.inf:
            raise ValueError(
                f"robot: {field}: expected a positive number, got {number}"
            )
    names = [thing.name for thing in room.things]
    for name in (*names, ROBOT):
        if [*names, ROBOT].count(name) > 1:
            raise ValueError(f"thing {name!r}: name: expected one of its own, got two")
    _check_places(room)
    return room


def _check_places(room: Room) -> None:
    """Refuse what is not within the walls, or where something else is."""
    low, high = room.bounds
    if not np.all(high > low):
        raise ValueError(
            "walls: expected left, bottom, right and top first, with room between "
            f"them, got {low.tolist()} to {high.tolist()}"
        )
    for field in ("start", "goal"):
        place = np.array(getattr(room, field))
        if not np.all((place > low) & (place < high)):
            raise ValueError(
                f"{field}: expected a place between {low.tolist()} and "
                f"{high.tolist()}, got {place.tolist()}"
            )
        _check_robot_fits(room, field, place)
    start = np.array([room.start])
    for thing in room.things:
        place = np.array(thing.pose[:2])
        if not np.all((place > low) & (place < high)):
            raise ValueError(
                f"thing {thing.name!r}: pose: expected its middle between "
                f"{low.tolist()} and {high.tolist()}, got {place.tolist()}"
            )
        gap = distance_to(start, thing.outline, np.array(thing.pose))[0]
        if gap < room.robot.radius - _SLACK:
            raise ValueError(
                f"thing {thing.name!r}: pose: expected {room.robot.radius:g} m from "
                f"the robot's start at least, got {gap:.3g} m"
            )


def _check_robot_fits(room: Room, field: str, place: np.ndarray) -> None:
    """Refuse a start or goal that the robot would be in a wall at."""
    for index, (x0, y0, x1, y1) in enumerate(room.walls):
        middle = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.0])
        half = (0.5 * (x1 - x0), 0.5 * (y1 - y0))
        gap = distance_to(place[None], half, middle)[0]
        if gap < room.robot.radius - _ROUNDING:
            raise ValueError(
                f"{field}: expected the robot's radius of {room.robot.radius:g} m from "
                f"every wall, got {gap:.3g} m from walls[{index}]"
            )
