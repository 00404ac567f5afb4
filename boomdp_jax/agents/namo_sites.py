"""Which things stand between regions on a robot's way to its goal."""

import math
from collections.abc import Sequence
from typing import NamedTuple


class Site(NamedTuple):
    """A pair of regions and the thing between them."""

    thing: int
    start: int
    end: int


def on_the_way(sites: Sequence[Site], here: int, goal: int) -> list[Site]:
    """Those on ways to the goal with at most one region more than the shortest.

    Args:
        sites: all of the room.
        here: the robot's region.
        goal: the goal's.
    """
    ahead = _hops([(s.start, s.end) for s in sites], here)
    back = _hops([(s.end, s.start) for s in sites], goal)
    least = ahead.get(goal, math.inf)
    return [
        site
        for site in sites
        if ahead.get(site.start, math.inf) + 1 + back.get(site.end, math.inf)
        <= least + 1
        and site.start != goal
        and site.end != here
    ]


def _hops(edges: Sequence[tuple[int, int]], start: int) -> dict[int, int]:
    """Fewest edges from a region to each other."""
    found, rim = {start: 0}, [start]
    while rim:
        level = 1 + found[rim[0]]
        rim = sorted({b for a, b in edges if a in rim and b not in found})
        found |= dict.fromkeys(rim, level)
    return found
