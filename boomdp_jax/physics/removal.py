"""Bodies that are there or not, as data: one compiled function for all of them."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from boomdp_jax.physics.params import WORLD, Params
from boomdp_jax.physics.scene import Scene


def remove_bodies(
    scene: Scene, params: Params, is_removed: Bool[Array, " body"]
) -> tuple[Scene, Params]:
    """Take bodies out of a scene without a change of any shape.

    What is removed stays where it is, touches nothing and holds nothing: joints with
    it are inactive, and it neither falls nor moves. A function that is compiled for the
    scene takes the result without being compiled again.

    Args:
        scene: outlines.
        params: one hypothesis.
        is_removed: which bodies.

    Returns:
        Both, with masks changed.
    """
    collides = scene.collides
    if collides is not None:
        stays = ~is_removed
        collides = collides & stays[:, None] & stays[None]
    scene = eqx.tree_at(
        lambda s: (s.is_static, s.collides),
        scene,
        (scene.is_static | is_removed, collides),
        is_leaf=lambda leaf: leaf is None,
    )
    changes = {
        name: _with_active(joint, joint.active & ~_has(joint, is_removed))
        for name in ("revolute", "distance", "prismatic", "weld")
        if (joint := getattr(params, name)) is not None
    }
    for name in ("wheel", "ground"):
        slots = getattr(params, name)
        changes[name] = _with_active(slots, slots.active & ~is_removed[:, None])
    return scene, type(params)(**{**vars(params), **changes})


def _has(joint, is_removed: Bool[Array, " body"]) -> Bool[Array, " joint"]:
    """Whether a slot ties a body that is removed."""
    is_b = (joint.body_b != WORLD) & is_removed[jnp.maximum(joint.body_b, 0)]
    return is_removed[joint.body_a] | is_b


def _with_active(slots, active):
    return type(slots)(**{**vars(slots), "active": active})
