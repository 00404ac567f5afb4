r"""Motions through a space of configurations: edges, lengths and timing, of any robot.

How far a robot moves between two configurations is bounded by its levers, metres per
unit of each coordinate: no point of it moves further than $\sum_i l_i |\Delta q_i|$.
Edges are checked at configurations no further apart than a resolution in that measure,
so that a robot that has half of it to spare at each of them has room all along.

`PlanMotion` is what a planner of motions is called like, whoever made it
(`interop.plan_motion`).
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

IsFree = Callable[[Float[np.ndarray, "point coordinate"]], Bool[np.ndarray, " point"]]
"""Which of some configurations are free of collision."""


@runtime_checkable
class PlanMotion(Protocol):
    """A planner of motions, as a plain function."""

    def __call__(
        self,
        seed: int,
        start: Float[np.ndarray, " coordinate"],
        goals: Float[np.ndarray, "goal coordinate"],
        is_free: IsFree,
        lower: Float[np.ndarray, " coordinate"],
        upper: Float[np.ndarray, " coordinate"],
        *,
        levers: Float[np.ndarray, " coordinate"],
        resolution: float,
        is_periodic: Bool[np.ndarray, " coordinate"] | None = None,
    ) -> Float[np.ndarray, "point coordinate"] | None:
        """Find a motion from the start to one of the goals.

        Args:
            seed: of the random numbers; equal ones give equal motions.
            start: configuration.
            goals: configurations, any of which will do.
            is_free: which of some configurations are free of collision.
            lower: least of each coordinate.
            upper: largest of each coordinate.
            levers: metres per unit of each coordinate.
            resolution: between configurations that are checked [m].
            is_periodic: which coordinates are angles of a full turn; none: no one.

        Returns:
            Corners of the motion, straight in between, from start to goal, angles not
            wrapped; None if none was found.
        """
        ...


class TimedMotion(NamedTuple):
    """A motion as a function of time, at the ends of steps of equal length."""

    configuration: Float[np.ndarray, "time coordinate"]
    rate: Float[np.ndarray, "time coordinate"]
    """Its first derivative [1/s]."""
    acceleration: Float[np.ndarray, "time coordinate"]
    """Its second derivative [1/s²]."""


def edge_points(
    start: Float[np.ndarray, " coordinate"],
    end: Float[np.ndarray, " coordinate"],
    levers: Float[np.ndarray, " coordinate"],
    resolution: float,
) -> Float[np.ndarray, "point coordinate"]:
    """Configurations along a straight edge, no further apart than the resolution.

    Args:
        start: configuration; the first point.
        end: configuration; the last point.
        levers: metres per unit of each coordinate.
        resolution: largest motion of the robot between two points [m].

    Returns:
        The points, at least two.

    Raises:
        ValueError: a resolution that is not positive.
    """
    if not resolution > 0.0:
        raise ValueError(f"resolution: expected a length above 0, got {resolution!r}")
    change = end - start
    num = max(int(np.ceil(np.sum(levers * np.abs(change)) / resolution)), 1)
    return start[None] + np.linspace(0.0, 1.0, num + 1)[:, None] * change[None]


def motion_points(
    path: Float[np.ndarray, "corner coordinate"],
    levers: Float[np.ndarray, " coordinate"],
    resolution: float,
) -> Float[np.ndarray, "point coordinate"]:
    """Configurations along a whole motion, corners included (`edge_points`).

    Args:
        path: corners.
        levers: metres per unit of each coordinate.
        resolution: largest motion of the robot between two points [m].

    Returns:
        The points.
    """
    edges = itertools.pairwise(path)
    parts = [edge_points(a, b, levers, resolution)[1:] for a, b in edges]
    return np.concatenate([path[:1], *parts])


def motion_length(
    path: Float[np.ndarray, "corner coordinate"],
    levers: Float[np.ndarray, " coordinate"],
) -> float:
    """Bound on how far any point of the robot moves in a motion [m].

    Args:
        path: corners.
        levers: metres per unit of each coordinate.

    Returns:
        The sum over its edges.
    """
    return float(np.sum(np.abs(np.diff(path, axis=0)) @ levers))


def timed_motion(
    path: Float[np.ndarray, "corner coordinate"],
    levers: Float[np.ndarray, " coordinate"],
    *,
    speed: float,
    acceleration: float,
    dt: float,
) -> TimedMotion:
    r"""Time a motion so that it rests at every corner, and no point is too fast.

    Along an edge of length D (`motion_length`) the share done is $3s^2 - 2s^3$ of the
    share s of its time, $T = \max(3D/2v, \sqrt{6D/a})$, rounded up to whole steps.

    Args:
        path: corners.
        levers: metres per unit of each coordinate.
        speed: largest, of any point of the robot [m/s].
        acceleration: largest, likewise, along straight ways [m/s²].
        dt: length of a step [s].

    Returns:
        The motion; no steps at all where it goes nowhere.

    Raises:
        ValueError: a speed, acceleration or step that is not positive.
    """
    limits = {"speed": speed, "acceleration": acceleration, "dt": dt}
    for name, limit in limits.items():
        if not limit > 0.0:
            raise ValueError(f"{name}: expected a number above 0, got {limit!r}")
    parts = [(np.empty((0, path.shape[1])),) * 3]
    for start, end in itertools.pairwise(path):
        length = float(np.sum(levers * np.abs(end - start)))
        shortest = max(1.5 * length / speed, np.sqrt(6.0 * length / acceleration))
        num = int(np.ceil(shortest / dt))
        if num == 0:
            continue
        share = np.arange(1, num + 1)[:, None] / num
        change, time = (end - start)[None], num * dt
        parts.append(
            (
                start[None] + (3.0 - 2.0 * share) * share**2 * change,
                6.0 * share * (1.0 - share) / time * change,
                (6.0 - 12.0 * share) / time**2 * change,
            )
        )
    return TimedMotion(*(np.concatenate(part) for part in zip(*parts, strict=True)))
