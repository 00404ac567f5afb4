r"""Axes of drawers against their bodies, so that objects of a kind share them.

A fit measures the axis from the way in which a body moved most (`resting`), which says
nothing of another body and is noise in one that never moved. Objects of a kind slide
the same way against their own outlines: among kinds the axis is measured from the
body's angle. An axis turned by half a turn is the same with its line on the other side.
"""

from typing import Any

import equinox as eqx
import numpy as np

from boomdp_jax.core.arrays import on_device
from boomdp_jax.inference.hypotheses.layout import Layout
from boomdp_jax.inference.likelihoods.target import StructureTarget


def drawer_places(layout: Layout) -> tuple[tuple[int, int], ...]:
    """First coordinate of each drawer, and its place in `Surroundings.rest`."""
    return tuple(
        (slot.start, place)
        for place, slot in enumerate(layout.rests)
        if slot.kind == "prismatic"
    )


def _rest_of(target: StructureTarget) -> Any:
    likelihood: Any = target.log_likelihood
    return likelihood.coordinates.surroundings.rest


def axis_turns(target: StructureTarget, layout: Layout) -> np.ndarray:
    """What has to be added to coordinates of axes [rad].

    Args:
        target: of one body, or of several along a leading axis.
        layout: of its coordinates.

    Returns:
        `[..., dim]`, zero for all others.
    """
    rest = np.asarray(_rest_of(target), float)
    turn = np.zeros((*rest.shape[:-2], layout.dim))
    for start, place in drawer_places(layout):
        turn[..., start] = rest[..., place, 3] - rest[..., place, 2]
    return turn


def measure_from_bodies(target: StructureTarget, layout: Layout) -> StructureTarget:
    """The same targets with axes measured from the bodies' angles."""
    rest = np.array(_rest_of(target))
    for _, place in drawer_places(layout):
        rest[..., place, 3] = rest[..., place, 2]
    return eqx.tree_at(_rest_of, target, on_device(rest, rest.dtype))


def turned_axes(
    z: np.ndarray, turn: np.ndarray, layout: Layout
) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates for targets of `measure_from_bodies`.

    Args:
        z: coordinates, `[..., dim]`.
        turn: of `axis_turns`, broadcast against them.
        layout: of the coordinates.

    Returns:
        The coordinates, and by what each was multiplied, 1 or -1.
    """
    z = z + turn
    sign = np.ones_like(z)
    for start, _ in drawer_places(layout):
        halves = np.floor(z[..., start] / np.pi + 0.5)
        z[..., start] -= np.pi * halves
        sign[..., start + 1] = 1.0 - 2.0 * np.mod(halves, 2.0)
    return z * sign, sign
