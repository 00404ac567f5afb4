"""Structures that say with several constraints what fewer say: they get no prior.

Welds make one rigid group of the bodies that they tie; one that holds the world does
not move at all. A set of constraints is redundant where

- a body that is welded to the world, directly or through others, has any other
  constraint: nothing moves, so nothing can be told of it;
- welds close a loop, or tie a group otherwise than each body to its first one (the
  world, if that is in it): the same group would be listed several times;
- a joint is listed with another body of a group than its first one, or lies within one;
- two groups (or a group and the world) are left no motion against each other: pin and
  drawer, two drawers, two pins, or either with a rod hold as a weld does, and the weld
  is listed instead.

The rules compare drawers and welds with everything else; where a scene knows neither
kind, structures are what they were without these.
"""

from collections.abc import Iterable
from typing import NamedTuple

from boomdp_jax.physics.params import WORLD

NEW_KINDS = ("prismatic", "weld")
"""Kinds whose presence calls for the rules."""

# Motions that a joint takes away, of the three that two bodies have.
_NUM_ROWS = {"revolute": 2, "distance": 1, "prismatic": 2}


class Tie(NamedTuple):
    """One constraint, as far as it matters here."""

    kind: str
    body_a: int
    body_b: int
    """Partner; `WORLD` for the world and for what has no partner."""
    is_inferred: bool
    """Known constraints are taken as they are, and only ever make others redundant."""


def is_redundant(ties: Iterable[Tie]) -> bool:
    """Whether some inferred constraint of a set is redundant.

    Args:
        ties: the constraints that exist, known and inferred.

    Returns:
        True where the structure should have no prior.
    """
    ties = list(ties)
    welds = [tie for tie in ties if tie.kind == "weld"]
    first = _first_of_group(welds)
    if any(_is_odd_weld(tie, first) for tie in welds if tie.is_inferred):
        return True
    if _has_loop(welds):
        return True
    rows: dict[tuple[int, int], int] = {}
    has_inferred: set[tuple[int, int]] = set()
    for kind, a, b, is_inferred in ties:
        if kind == "weld":
            continue
        root_a, root_b = first.get(a, a), first.get(b, b)
        if kind not in _NUM_ROWS:
            if root_a == WORLD and is_inferred:
                return True
            continue
        if is_inferred and ((root_a, root_b) != (a, b) or root_a == root_b):
            return True
        pair = (min(root_a, root_b), max(root_a, root_b))
        rows[pair] = rows.get(pair, 0) + _NUM_ROWS[kind]
        if is_inferred:
            has_inferred.add(pair)
    return any(rows[pair] > 2 for pair in has_inferred)


def _first_of_group(welds: list[Tie]) -> dict[int, int]:
    """First body of the group of each welded body; `WORLD` comes before all."""
    first: dict[int, int] = {}
    for _ in welds:
        # As many rounds as there are welds reach the end of any chain.
        for tie in welds:
            ends = (tie.body_a, tie.body_b)
            root = min(first.get(body, body) for body in ends)
            first |= dict.fromkeys(ends, root)
    return first


def _is_odd_weld(tie: Tie, first: dict[int, int]) -> bool:
    """Whether a weld ties its group otherwise than to the first body."""
    return first[tie.body_a] not in (tie.body_a, tie.body_b)


def _has_loop(welds: list[Tie]) -> bool:
    """Whether there are more welds than a tree of the bodies has, one inferred."""
    bodies = {body for tie in welds for body in (tie.body_a, tie.body_b)}
    roots = {_first_of_group(welds)[body] for body in bodies}
    is_any_inferred = any(tie.is_inferred for tie in welds)
    return is_any_inferred and len(welds) > len(bodies) - len(roots)
