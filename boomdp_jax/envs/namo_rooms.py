"""Rooms for a robot that moves furniture: the paper's own, and random ones.

The story room is measured from the picture of Scholz et al. (2014), a pixel being a
centimetre: a couch and a round table stand in an opening of the middle wall, and the
gaps beside them are narrower than the robot. Random rooms have a wall with two doors,
each of which something closes; `random_room` only returns rooms that a robot who knows
the truth can solve, moving one thing at a time (`is_solvable`).
"""

import math
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from boomdp_jax.envs.checked_room import check_room
from boomdp_jax.envs.free_space import FreeSpace, pose_table
from boomdp_jax.envs.namo_room import KINDS, LOOKS, Robot, Room, Thing
from boomdp_jax.physics.scene_spec import STANDARD_GRAVITY
from boomdp_jax.planning.regions import label_regions

Wall = tuple[float, float, float, float]

_WIDE, _HIGH, _THICK = 8.0, 6.0, 0.16
_STORY_ROBOT = Robot(radius=0.4)
"""The paper's is 105 by 75 pixels; a disc of 80."""
_MOST_THINGS = 12
"""Of which a room is found within seconds. With 14 one try may take several; with 20,
a minute may not be enough."""
_MOST_TRIES = 30
"""Every second try or so is a room, whatever its number of things."""
# Share of each kind, by label: free, heavy, wheels, revolute, fixed.
_KIND_SHARES: Mapping[str, tuple[float, ...]] = MappingProxyType(
    {
        "chair": (0.6, 0.1, 0.2, 0.0, 0.1),
        "table": (0.4, 0.15, 0.0, 0.35, 0.1),
        "couch": (0.45, 0.35, 0.1, 0.0, 0.1),
        "shelf": (0.25, 0.35, 0.0, 0.0, 0.4),
        "trolley": (0.2, 0.0, 0.8, 0.0, 0.0),
    }
)
_ALIKE = 0.85
"""Share of things of one label that are of its kind in this room; the rest are not."""
_LEAST_CELLS = 6


def story_room(seed: int = 0) -> Room:
    """The paper's picture: the table is nearest and lightest, and turns about a pin.

    Args:
        seed: of what the picture does not tell: densities, friction, where the pin is,
            and some centimetres.

    Returns:
        The room.
    """
    rng = np.random.default_rng([2014, seed])
    jitter = rng.uniform(-0.03, 0.03, size=4)
    density = _densities(rng)
    # A pin a hand's breadth off the middle, as of a table with a foot that is screwed
    # down: it can be told from a fixed one.
    angle, off = rng.uniform(0, 2 * math.pi), rng.uniform(0.05, 0.15)
    couch = Thing(
        name="couch",
        label="couch",
        outline=(0.36, 1.03),
        pose=(4.06 + jitter[0], 2.01 + 0.5 * jitter[1], 0.0),
        kind="free",
        density=density["couch"],
        friction=float(rng.uniform(0.2, 0.35)),
    )
    table = Thing(
        name="table",
        label="table",
        outline=(0.67,),
        pose=(4.0 + jitter[2], 4.2 + 0.5 * jitter[3], 0.0),
        kind="revolute",
        density=density["table"],
        friction=0.3,
        pin=(off * math.cos(angle), off * math.sin(angle)),
    )
    walls: tuple[Wall, ...] = (
        *_outer(8.0, 6.0),
        (3.92, 0.0, 4.08, 0.67),
        (3.92, 5.34, 4.08, 6.0),
    )
    return check_room(
        Room((couch, table), walls, (1.2, 4.82), (6.92, 3.07), _STORY_ROBOT)
    )


def random_room(seed: int, num_things: int, *, difficulty: float = 0.5) -> Room:
    """A room with two doors that are closed, and more furniture about.

    Args:
        seed: which; the same seed is the same room.
        num_things: from 2 to 12, of which a room is found within seconds.
        difficulty: from 0, nothing is heavy, pinned or fixed, to 1, twice as much as
            usual.

    Returns:
        A room that can be solved.

    Raises:
        ValueError: fewer or more things, a difficulty outside [0, 1], or a seed for
            which no such room was found among many.
    """
    if num_things < 2:
        raise ValueError(f"num_things: expected at least 2, got {num_things}")
    if num_things > _MOST_THINGS:
        raise ValueError(
            f"num_things: expected at most {_MOST_THINGS}, got {num_things}"
        )
    if not 0.0 <= difficulty <= 1.0:
        raise ValueError(f"difficulty: expected in [0, 1], got {difficulty}")
    rng = np.random.default_rng([num_things, seed])
    for _ in range(_MOST_TRIES):
        room = _try_room(rng, num_things, difficulty)
        if room is not None and is_closed(room) and is_solvable(room):
            return check_room(room)
    raise ValueError(
        f"seed: expected one with a room of {num_things} things that can be solved, "
        f"got {seed}, which has none in {_MOST_TRIES} tries; take fewer things or less "
        "difficulty"
    )


def is_closed(room: Room) -> bool:
    """Whether the robot cannot get to its goal without moving something."""
    space, _, labels = _mapped(room)
    start, goal = (labels[tuple(space.grid.cell(p))] for p in (room.start, room.goal))
    return bool(start > 0 and goal > 0 and start != goal)


def is_solvable(room: Room) -> bool:
    """Whether a robot who knows what all things are can get to its goal.

    Moving one thing from each region to the next: of its poses that overlap nothing,
    one that opens the way can be reached from where it stands as its kind allows (by
    sliding anywhere, by rolling and turning on its axle, by turning about its pin), and
    the robot can get at it. Nothing is said of forces but that it is not too heavy.

    Args:
        room: the room, the truth included.
    """
    space, poses, labels = _mapped(room)
    here, goal = (
        int(labels[tuple(space.grid.cell(p))]) for p in (room.start, room.goal)
    )
    sizes = np.bincount(labels.reshape(-1))
    keep = np.zeros(labels.shape, bool)
    keep[tuple(space.grid.cell(room.goal))] = True
    edges = set()
    for index, thing in enumerate(room.things):
        if not _can_move(thing, room.robot):
            continue
        joined, num = label_regions(space.free(poses, without=index))
        for region in range(1, num + 1):
            parts = np.unique(labels[joined == region])
            parts = [int(p) for p in parts if p > 0 and sizes[p] >= _LEAST_CELLS]
            for one in parts:
                for other in parts:
                    ends = labels == one, labels == other
                    if one < other and _opens(space, index, poses, *ends, keep):
                        edges |= {(one, other), (other, one)}
    found, rim = {here}, [here]
    while rim:
        rim = [b for a, b in edges if a in rim and b not in found]
        found |= set(rim)
    return goal in found


def _mapped(room: Room) -> tuple[FreeSpace, np.ndarray, np.ndarray]:
    space = FreeSpace(room)
    poses = np.array([thing.pose for thing in room.things])
    return space, poses, label_regions(space.free(poses))[0]


def _can_move(thing: Thing, robot: Robot) -> bool:
    """Whether the robot is strong enough, with something to spare."""
    if thing.kind == "fixed":
        return False
    if thing.kind in ("free", "heavy"):
        return thing.friction * thing.mass * STANDARD_GRAVITY < 0.9 * robot.force
    return True


def _opens(
    space: FreeSpace,
    index: int,
    poses: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    keep: np.ndarray,
) -> bool:
    """Whether a pose that opens the way can be reached as the kind allows."""
    thing = space.room.things[index]
    table = pose_table(space, index, poses, start, end, keep=keep)
    if not table.opened.any():
        return False
    now = np.asarray(poses[index], float)
    found, rim = set(), [now]
    while rim:
        pose = rim.pop()
        cell = _cell(table, pose)
        if cell is None or cell in found or table.blocked[cell]:
            continue
        if table.opened[cell]:
            return True
        found.add(cell)
        rim += _moves(thing, pose, table.step)
    return False


def _cell(table, pose: np.ndarray) -> tuple[int, ...] | None:
    index = np.rint((pose - table.low) / table.step).astype(int)
    num = table.blocked.shape
    if np.any(index[:2] < 0) or np.any(index[:2] >= num[:2]):
        return None
    return int(index[0]), int(index[1]), int(index[2]) % num[2]


def _moves(thing: Thing, pose: np.ndarray, step) -> list[np.ndarray]:
    """Poses next to one, as the kind allows."""
    turns = [step[2], -step[2]]
    if thing.kind in ("free", "heavy"):
        sides = step[0] * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        slid = [pose + np.append(side, 0.0) for side in sides]
        return slid + [pose + np.array([0.0, 0.0, turn]) for turn in turns]
    about = np.asarray(thing.axle[:2] if thing.kind == "wheels" else thing.pin)
    moved = [_turned_about(pose, about, turn) for turn in turns]
    if thing.kind == "wheels":
        heading = pose[2] + thing.axle[2]
        along = step[0] * np.array([np.cos(heading), np.sin(heading), 0.0])
        moved += [pose + along, pose - along]
    return moved


def _turned_about(pose: np.ndarray, own: np.ndarray, turn: float) -> np.ndarray:
    """A pose after a turn about a point of the body's own."""

    def rotated(angle):
        cos, sin = math.cos(angle), math.sin(angle)
        return np.array([cos * own[0] - sin * own[1], sin * own[0] + cos * own[1]])

    place = pose[:2] + rotated(pose[2]) - rotated(pose[2] + turn)
    return np.array([*place, pose[2] + turn])


def _outer(wide: float, high: float) -> tuple[Wall, ...]:
    t = _THICK
    return (
        (-t, -t, 0.0, high + t),
        (-t, -t, wide + t, 0.0),
        (wide, -t, wide + t, high + t),
        (-t, high, wide + t, high + t),
    )


def _densities(rng: np.random.Generator) -> dict[str, float]:
    """Of things of each label in one room."""
    return {
        label: float(look.density * np.exp(look.spread * rng.standard_normal()))
        for label, look in LOOKS.items()
    }


def _try_room(
    rng: np.random.Generator, num_things: int, difficulty: float
) -> Room | None:
    """A room as it comes, or none if something found no place."""
    x = rng.uniform(3.6, 4.4)
    doors = [(rng.uniform(1.1, 1.9), rng.uniform(1.1, 1.6)) for _ in range(2)]
    doors[1] = (6.0 - doors[1][0], doors[1][1])
    (low, low_wide), (high, high_wide) = doors
    half = 0.5 * _THICK
    walls: tuple[Wall, ...] = (
        *_outer(_WIDE, _HIGH),
        (x - half, 0.0, x + half, low - 0.5 * low_wide),
        (x - half, low + 0.5 * low_wide, x + half, high - 0.5 * high_wide),
        (x - half, high + 0.5 * high_wide, x + half, _HIGH),
    )
    start = (rng.uniform(0.6, 2.0), rng.uniform(0.6, 5.4))
    goal = (rng.uniform(6.0, 7.4), rng.uniform(0.6, 5.4))
    density, kind = _densities(rng), _kinds(rng, difficulty)
    room = Room((), walls, start, goal)
    num_pinned = 0
    for index in range(num_things):
        for _ in range(40):
            label = str(rng.choice(list(LOOKS)))
            own = kind[label] if rng.random() < _ALIKE else None
            if own is None:
                own = str(rng.choice(KINDS, p=_shares(label, difficulty)))
            # No more pins than a room has room for.
            if own == "revolute" and num_pinned == 2:
                own = "free"
            near = (x, doors[index][0]) if index < 2 else None
            thing = _place(rng, room, f"{label} {index}", label, own, density, near)
            if thing is not None:
                room = room._replace(things=(*room.things, thing))
                num_pinned += own == "revolute"
                break
        else:
            return None
    return room


def _shares(label: str, difficulty: float) -> np.ndarray:
    share = np.array(_KIND_SHARES[label])
    hard = np.array([kind in ("heavy", "revolute", "fixed") for kind in KINDS])
    share = np.where(hard, 2.0 * difficulty * share, share)
    return share / share.sum()


def _kinds(rng: np.random.Generator, difficulty: float) -> dict[str, str]:
    return {
        label: str(rng.choice(KINDS, p=_shares(label, difficulty))) for label in LOOKS
    }


def _place(
    rng: np.random.Generator,
    room: Room,
    name: str,
    label: str,
    kind: str,
    density: Mapping[str, float],
    near: tuple[float, float] | None,
) -> Thing | None:
    """A thing near a place, or anywhere, that overlaps nothing; None: it would."""
    outline = _outline(rng, label)
    heavier = 1.0
    friction = float(rng.uniform(0.2, 0.4))
    area = math.pi * outline[0] ** 2 if len(outline) == 1 else 4 * math.prod(outline)
    if kind in ("free", "heavy"):
        # Light ones take up to half of the robot's force, heavy ones more, some of
        # them all there is.
        part = rng.uniform(0.6, 1.1) if kind == "heavy" else rng.uniform(0.15, 0.5)
        needed = part * room.robot.force
        weight = friction * density[label] * area * STANDARD_GRAVITY
        if kind == "heavy":
            heavier = needed / weight
        elif weight > 0.5 * room.robot.force:
            friction *= needed / weight
    axle, pin = (0.0, 0.0, 0.0), (0.0, 0.0)
    if kind == "wheels":
        back = 0.7 * outline[0] if rng.random() < 0.5 else 0.0
        axle = (-back, 0.0, 0.0)
    if kind == "revolute":
        angle = rng.uniform(0, 2 * math.pi)
        off = rng.uniform(0.1, 0.4) * min(outline)
        pin = (off * math.cos(angle), off * math.sin(angle))
    angle = float(rng.choice([0.0, 0.5 * math.pi]) + rng.uniform(-0.2, 0.2))
    if near is not None:
        place = np.array(near) + rng.uniform([-0.35, -0.3], [0.35, 0.3])
    else:
        place = rng.uniform([0.4, 0.4], [_WIDE - 0.4, _HIGH - 0.4])
    thing = Thing(
        name=name,
        label=label,
        outline=outline,
        pose=(float(place[0]), float(place[1]), angle),
        kind=kind,
        density=density[label] * heavier,
        friction=friction,
        axle=axle,
        pin=pin,
    )
    space = FreeSpace(room._replace(things=(*room.things, thing)))
    poses = np.array([t.pose for t in space.room.things])
    own = len(poses) - 1
    if space.overlaps(own, poses[own:], poses)[0]:
        return None
    closed = space.closed_by(own, poses[own])
    ends = [tuple(space.grid.cell(p)) for p in (room.start, room.goal)]
    return None if any(closed[end] for end in ends) else thing


def _outline(rng: np.random.Generator, label: str) -> tuple[float, ...]:
    size = rng.uniform(0.9, 1.1)
    if label == "table" and rng.random() < 0.5:
        return (0.5 * size,)
    half = {
        "chair": (0.25, 0.25),
        "table": (0.6, 0.4),
        "couch": (0.85, 0.4),
        "shelf": (0.6, 0.22),
        "trolley": (0.45, 0.3),
    }[label]
    return (half[0] * size, half[1] * size)
