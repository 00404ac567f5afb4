"""What the bodies of a block may touch: each other, and the walls near them."""

import dataclasses

import jax
import numpy as np

from boomdp_jax.core.arrays import on_device
from boomdp_jax.inference.hypotheses.contact_prediction import (
    NUM_SUBSTEPS,
    ContactScene,
)
from boomdp_jax.inference.hypotheses.coordinates import Contact
from boomdp_jax.inference.hypotheses.first_touch import sort_pairs
from boomdp_jax.inference.readings.touching import Touching
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.scene_arrays import DEFAULT_FRICTION, DEFAULT_RESTITUTION
from boomdp_jax.physics.scene_spec import SceneSpec

_OF_BODIES = (
    "vertices",
    "vertex_mask",
    "radius",
    "area",
    "gyration",
    "feet",
    "foot_load",
    "foot_size",
    "corner_load",
    "diagonal",
    "stance_axis",
    "is_static",
)


def block_contact(
    spec: SceneSpec, bodies: tuple[int, ...], touching: Touching, apart: Scene
) -> Contact:
    """Gather outlines, walls and surfaces.

    Args:
        spec: a scene with contact.
        bodies: indices of the block's bodies in the scene.
        touching: what may have touched.
        apart: the scene of these bodies without contact.

    Returns:
        What `Coordinates` need. Bodies that never came near each other are not
        simulated as if they could touch.
    """
    walls = touching.walls_of(spec, bodies)
    index = np.array(bodies + walls)
    whole = spec.scene
    picked = {
        name: jax.tree.map(
            lambda leaf: on_device(np.asarray(leaf)[index], leaf.dtype),
            getattr(whole, name),
        )
        for name in _OF_BODIES
    }
    collides = touching.pairs[np.ix_(index, index)]
    scene = dataclasses.replace(
        whole,
        **picked,
        collides=on_device(collides, bool),
        num_substeps=NUM_SUBSTEPS if spec.substeps is None else spec.substeps,
    )
    pairs = [(int(a), int(b)) for a, b in np.argwhere(np.triu(collides))]
    is_disc = np.array([spec.bodies[i].radius > 0 for i in index])
    inferred = touching.inferred_in(spec, bodies)

    def known(name: str, default: float) -> np.ndarray:
        values = [getattr(spec.bodies[i], name) for i in index]
        filled = np.array([default if v is None else v for v in values], float)
        # Of bodies that touch nothing of the kind it does not matter.
        is_dropped = np.isnan(filled) & (name not in inferred)
        return np.where(is_dropped, default, filled)

    return Contact(
        world=ContactScene(
            scene=scene,
            wall_pose=on_device(spec.pose[list(walls)].reshape(-1, 3)),
            sorts=sort_pairs(pairs, is_disc),
            apart=apart,
        ),
        friction=on_device(known("friction", DEFAULT_FRICTION)),
        restitution=on_device(known("restitution", DEFAULT_RESTITUTION)),
    )
