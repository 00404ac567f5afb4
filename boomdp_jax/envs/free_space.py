"""Where a disc can be among furniture and walls, and what moving one thing opens.

Cells of a grid are closed where the disc's middle would be nearer to an outline than
its radius. For one thing, with all others where they are, `PoseTable` says of each of
its poses nearby whether it would overlap something, and whether the disc could then get
from one region to another.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from boomdp_jax.envs.namo_room import Room
from boomdp_jax.planning.flood import MOST_CELLS, packed, reached
from boomdp_jax.planning.regions import Grid, grid_between

SPACING = 0.125
"""Of the grid on which regions are found [m]; wider in rooms that are more than
`flood.MOST_CELLS` of it across."""
MARGIN = 0.03
"""By which ways stay clear of things, beside the robot's radius [m]."""
_NUM_STEPS = 10
"""How many cells from where it stands, to each side, a thing is looked at."""
_NUM_ANGLES = 16
"""Headings round the circle, of a box."""


Outline = Sequence[float] | np.ndarray
"""Half extents of a box, or the radius of a disc alone [m]."""


def distance_to(
    places: Float[np.ndarray, "*any 2"],
    outline: Outline,
    pose: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "*any"]:
    """Distance from places to a box or a disc; zero or negative inside [m].

    Args:
        places: in the world [m].
        outline: half extents, or a radius alone [m].
        pose: of the outline's middle [m, m, rad].
    """
    away = np.asarray(places, float) - np.asarray(pose, float)[:2]
    if len(outline) == 1:
        return np.linalg.norm(away, axis=-1) - outline[0]
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    own = np.stack(
        [
            cos * away[..., 0] + sin * away[..., 1],
            cos * away[..., 1] - sin * away[..., 0],
        ],
        axis=-1,
    )
    beyond = np.abs(own) - np.asarray(outline)
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
    return outside + np.minimum(np.max(beyond, axis=-1), 0.0)


class FreeSpace:
    """Maps of one room for its robot, on the host."""

    def __init__(self, room: Room, *, spacing: float = SPACING):
        """Lay the grid over the room."""
        self.room = room
        self.clearance = room.robot.radius + MARGIN
        low, high = room.bounds
        # Columns of the grid are words of bits (`flood`), along the shorter side.
        least = float(np.min(high - low)) / (MOST_CELLS - 1)
        self.grid: Grid = grid_between(low, high, max(spacing, least))
        self.places = self.grid.places
        walls = [_box(wall) for wall in room.walls]
        self._walls = walls
        self.open = np.ones(self.grid.shape, bool)
        for half, pose in walls:
            self.open &= distance_to(self.places, half, pose) > self.clearance

    def closed_by(
        self, thing: int, pose: Float[np.ndarray, "3"]
    ) -> Bool[np.ndarray, "x y"]:
        """Cells that a thing at a pose closes."""
        outline = self.room.things[thing].outline
        return distance_to(self.places, outline, pose) <= self.clearance

    def free(
        self, poses: Float[np.ndarray, "thing 3"], *, without: int | None = None
    ) -> Bool[np.ndarray, "x y"]:
        """Cells where the robot's middle may be.

        Args:
            poses: of all things.
            without: a thing that is left out.
        """
        free = self.open.copy()
        for thing, pose in enumerate(np.asarray(poses)):
            if thing != without:
                free &= ~self.closed_by(thing, pose)
        return free

    def overlaps(
        self,
        thing: int,
        poses: Float[np.ndarray, "pose 3"],
        others: Float[np.ndarray, "thing 3"],
    ) -> Bool[np.ndarray, "pose"]:
        """Whether a thing at some poses would overlap a wall or another thing.

        Args:
            thing: which.
            poses: where it might be.
            others: poses of all things; its own is not looked at.
        """
        own = self.room.things[thing].outline
        around = [(half, pose) for half, pose in self._walls]
        around += [
            (np.asarray(other.outline), np.asarray(pose, float))
            for index, (other, pose) in enumerate(
                zip(self.room.things, others, strict=True)
            )
            if index != thing
        ]
        hit = np.zeros(len(poses), bool)
        for outline, pose in around:
            hit |= _overlap(own, np.asarray(poses, float), outline, pose)
        return hit


class PoseTable(NamedTuple):
    """What becomes of the robot's ways with a thing at each of many poses."""

    low: tuple[float, float, float]
    """First pose [m, m, rad]."""
    step: tuple[float, float, float]
    blocked: Bool[np.ndarray, "x y angle"]
    """The thing would overlap something."""
    opened: Bool[np.ndarray, "x y angle"]
    """Start and end are connected, and nothing overlaps."""
    ahead: Float[np.ndarray, "x y angle"]
    """Distance to the nearest pose that is opened, an angle counting by the thing's
    radius of gyration [m]; infinite, if there is none."""


def pose_table(
    space: FreeSpace,
    thing: int,
    poses: Float[np.ndarray, "thing 3"],
    start: Bool[np.ndarray, "x y"],
    end: Bool[np.ndarray, "x y"],
    *,
    keep: Bool[np.ndarray, "x y"] | None = None,
) -> PoseTable:
    """Look at all poses of a thing round where it is.

    Args:
        space: the room's maps.
        thing: which may be moved.
        poses: of all things now.
        start: cells of the region in which the robot is.
        end: cells of the region that it is to get to.
        keep: cells that the thing must not close, such as the goal's.

    Returns:
        The table; of a disc with one angle.
    """
    outline = space.room.things[thing].outline
    now = np.asarray(poses[thing], float)
    step = space.grid.spacing
    # A box is the same turned by half a circle.
    num_angles = 1 if len(outline) == 1 else _NUM_ANGLES
    turn = 2 * math.pi / num_angles
    angles = turn * np.arange(max(num_angles // 2, 1))
    side = step * np.arange(-_NUM_STEPS, _NUM_STEPS + 1)
    mesh = np.meshgrid(angles, now[0] + side, now[1] + side, indexing="ij")
    every = np.stack(mesh[1:] + mesh[:1], axis=-1)
    blocked = space.overlaps(thing, every.reshape(-1, 3), poses)
    blocked = blocked.reshape(every.shape[:3])
    base = space.free(poses, without=thing)
    opened = np.stack(
        [
            _connected(
                space, outline, np.append(now[:2], angle), base, (start, end, keep)
            )
            for angle in angles
        ]
    )
    opened &= ~blocked

    def whole(part):
        repeated = np.concatenate([part] * (num_angles // len(angles)))
        return np.moveaxis(repeated, 0, -1)

    blocked, opened = whole(blocked), whole(opened)
    arm = 1.0 if len(outline) == 1 else turn * _gyration(outline)
    return PoseTable(
        low=(now[0] + side[0], now[1] + side[0], 0.0),
        step=(step, step, turn),
        blocked=blocked,
        opened=opened,
        ahead=_ahead(opened, (step, step, arm)),
    )


def _connected(
    space: FreeSpace,
    outline: Outline,
    pose: Float[np.ndarray, "3"],
    base: Bool[np.ndarray, "x y"],
    regions: tuple,
) -> Bool[np.ndarray, "along across"]:
    """Whether the regions are joined, for each place of the thing round a pose.

    Places are whole cells apart, so that what the thing closes is the same everywhere
    but for a shift.
    """
    num = _NUM_STEPS
    grid = space.grid
    wide = Grid(
        (grid.low[0] - num * grid.spacing, grid.low[1] - num * grid.spacing),
        grid.spacing,
        (grid.shape[0] + 2 * num, grid.shape[1] + 2 * num),
    )
    near = distance_to(wide.places, outline, pose) <= space.clearance
    turned = grid.shape[1] > MOST_CELLS

    def words(cells):
        return packed(np.swapaxes(cells, -1, -2) if turned else cells)

    shifts = range(2 * num, -1, -1)
    x, y = grid.shape
    # Shifted by so much, the thing closes what it closes there now.
    closed = np.stack([[near[i : i + x, j : j + y] for j in shifts] for i in shifts])
    closed = words(closed)
    free = words(base) & ~closed
    start, end, keep = regions
    joined = np.any(reached(free, words(start)) & words(end) & free != 0, axis=-1)
    if keep is None:
        return joined
    return joined & ~np.any(closed & words(keep) != 0, axis=-1)


def _distance_in_frame(away: np.ndarray, angle: np.ndarray, outline) -> np.ndarray:
    """As `distance_to`, of many poses."""
    if len(outline) == 1:
        return np.sqrt(away[..., 0] ** 2 + away[..., 1] ** 2) - outline[0]
    cos, sin = np.cos(angle)[:, None, None], np.sin(angle)[:, None, None]
    x = np.abs(cos * away[..., 0] + sin * away[..., 1]) - outline[0]
    y = np.abs(cos * away[..., 1] - sin * away[..., 0]) - outline[1]
    outside = np.sqrt(np.maximum(x, 0.0) ** 2 + np.maximum(y, 0.0) ** 2)
    return outside + np.minimum(np.maximum(x, y), 0.0)


def _ahead(opened: np.ndarray, step: tuple[float, float, float]) -> np.ndarray:
    """Distance to what is opened, round the circle of angles."""
    if not opened.any():
        return np.full(opened.shape, np.inf)
    num = opened.shape[2]
    thrice = np.concatenate([opened] * 3, axis=2)
    away = ndimage.distance_transform_edt(~thrice, sampling=step)
    return np.asarray(away)[..., num : 2 * num]


def _gyration(outline: Outline) -> float:
    """Radius of gyration of a box [m]."""
    return math.hypot(*outline) / math.sqrt(3.0)


def _box(wall: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    x0, y0, x1, y1 = wall
    half = np.array([0.5 * (x1 - x0), 0.5 * (y1 - y0)])
    return half, np.array([x0 + half[0], y0 + half[1], 0.0])


def _corners(outline: Outline, pose: np.ndarray) -> np.ndarray:
    """Of a box at one or many poses; `[..., 4, 2]`."""
    half = np.asarray(outline)
    own = half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    cos, sin = np.cos(pose[..., 2:3]), np.sin(pose[..., 2:3])
    x = cos * own[:, 0] - sin * own[:, 1] + pose[..., 0:1]
    y = sin * own[:, 0] + cos * own[:, 1] + pose[..., 1:2]
    return np.stack([x, y], axis=-1)


def _overlap(
    own: Outline, poses: np.ndarray, outline: Outline, pose: np.ndarray
) -> Bool[np.ndarray, "pose"]:
    """Whether an outline at many poses overlaps another one at its own."""
    if len(own) == 1:
        return distance_to(poses[:, :2], outline, pose) < own[0]
    if len(outline) == 1:
        away = np.broadcast_to(pose[:2], (len(poses), 2)) - poses[:, :2]
        return (
            _distance_in_frame(away[:, None, None], poses[:, 2], own)[:, 0, 0]
            < outline[0]
        )
    # Boxes: apart exactly where an edge's normal of either parts them.
    mine, other = _corners(own, poses), _corners(outline, pose)
    apart = np.zeros(len(poses), bool)
    for angle in (poses[:, 2], np.full(len(poses), pose[2])):
        for more in (0.0, 0.5 * math.pi):
            axis = np.stack([np.cos(angle + more), np.sin(angle + more)], axis=-1)
            p = np.einsum("nvi,ni->nv", mine, axis)
            q = np.einsum("vi,ni->nv", other, axis)
            apart |= (p.max(axis=1) < q.min(axis=1)) | (q.max(axis=1) < p.min(axis=1))
    return ~apart
