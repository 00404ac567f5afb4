"""What the contacts of a world need and no step changes: outlines, filters, surfaces.

All arrays are in lanes (`core.lanes`): `[body, lane]`, or `[pair, lane]` for one round
of the tournament of pairs.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.physics.contact_rows import Ease
from boomdp_jax.physics.params import WORLD, Params
from boomdp_jax.physics.prepare import Prepared
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.tournament import Rounds, as_rounds, each_round, pairs

PerBody = Float[Array, "body lane"]

# Edges shorter than this [m] have no direction: the repeated corners of an outline
# with fewer of them than there is room for.
_TINY_EDGE = 1e-9


class Outlines(NamedTuple):
    """Outlines about the centres of mass, in the bodies' frames."""

    corner_x: list[PerBody]
    corner_y: list[PerBody]


class Fixed(NamedTuple):
    """What is the same for a pair in every step."""

    inverse_length: list[PerBody]
    radius: PerBody
    friction: PerBody
    restitution: PerBody


class ContactWorld(NamedTuple):
    """What the contacts of a world need and no step changes."""

    outlines: Outlines
    turns: PerBody
    """One where there are corners, which turn with the body. Zero for a disc: whichever
    of its points faces another body, it is as far away as any other was."""
    fixed: Rounds
    """`Fixed` of both bodies of each pair, round by round."""
    allowed: Rounds
    """One where a pair may collide, else zero, `[pair, lane]`, round by round."""
    eases: Rounds
    """`contact_rows.Ease` of both bodies of each pair, round by round, as if nothing
    held them."""
    smoothing: Float[Array, " lane"] | None
    """`Scene.smoothing`."""


def contact_world(scene: Scene, params: Params, prepared: Prepared) -> ContactWorld:
    """Gather it.

    Args:
        scene: outlines and filters, in lanes.
        params: surfaces and joints, in lanes.
        prepared: which bodies can move, and their masses, in lanes.

    Returns:
        All that the time loop needs.
    """
    surface = params.surface
    assert surface is not None
    num_bodies, num_vertices = scene.vertices.shape[:2]
    has_corners = scene.radius == 0.0
    x = [
        jnp.where(has_corners, scene.vertices[:, i, 0], 0.0)
        for i in range(num_vertices)
    ]
    y = [
        jnp.where(has_corners, scene.vertices[:, i, 1], 0.0)
        for i in range(num_vertices)
    ]
    inverse_length = []
    for i in range(num_vertices):
        j = (i + 1) % num_vertices
        square = (x[j] - x[i]) ** 2 + (y[j] - y[i]) ** 2
        is_edge = square > _TINY_EDGE**2
        inverse_length.append(
            jnp.where(is_edge, 1.0 / jnp.sqrt(jnp.where(is_edge, square, 1.0)), 0.0)
        )
    fixed = each_round(
        Fixed(inverse_length, scene.radius, surface.friction, surface.restitution),
        num_bodies,
    )
    light = prepared.mobile / prepared.mass
    ease = Ease(light, light, prepared.mobile / prepared.inertia)
    return ContactWorld(
        Outlines(x, y),
        has_corners.astype(scene.radius.dtype),
        fixed,
        _of_pairs(_may_touch(scene, params, prepared)),
        each_round(ease, num_bodies),
        scene.smoothing,
    )


def _may_touch(scene: Scene, params: Params, prepared: Prepared):
    """Filters, joints and immobile pairs, as zeros and ones `[body, body, lane]`."""
    collides = scene.collides
    assert collides is not None
    num_bodies = collides.shape[0]
    can_move = (prepared.mobile[:, None] + prepared.mobile[None]) > 0.0
    allowed = collides & can_move
    index = np.arange(num_bodies)
    joints = (params.revolute, params.distance, params.prismatic, params.weld)
    for joint in joints:
        if joint is None:
            continue
        for slot in range(joint.active.shape[0]):
            is_a = joint.body_a[slot][None] == index[:, None]
            is_b = joint.body_b[slot][None] == index[:, None]
            on = joint.active[slot] & (joint.body_b[slot] != WORLD)
            one_way = is_a[:, None] & is_b[None] & on[None, None]
            allowed = allowed & ~one_way & ~jnp.swapaxes(one_way, 0, 1)
    return allowed.astype(prepared.mass.dtype)


def _of_pairs(table: Float[Array, "body body lane"]) -> Rounds:
    """Entries of each round's pairs; zero where somebody meets nobody."""
    num_bodies = table.shape[0]
    first, second = (np.stack(row) for row in zip(*pairs(num_bodies), strict=True))
    is_met = np.maximum(first, second) < num_bodies
    first, second = np.where(is_met, first, 0), np.where(is_met, second, 0)
    entries = table.reshape(num_bodies**2, -1)[first * num_bodies + second]
    return as_rounds(jnp.where(is_met[..., None], entries, 0.0), num_bodies)
