"""Ours: the public `rollout` on a scene as read from its file, `vmap` over worlds.

Float32, the default substeps; every state and report is returned, so that nothing is
optimised away. One hypothesis for all worlds, as the peers have one model.
"""

import jax
import jax.numpy as jnp
import numpy as np
from _peers_program import NotExpressibleError, Peer, Program, compiled_program

from boomdp_jax.physics import Scene, rollout, state_from_array
from boomdp_jax.physics.scene_spec import SceneSpec

HAS_CONTACT = "collides" in Scene.__dataclass_fields__
"""Whether the engine collides bodies."""


def needs_contact(spec: SceneSpec) -> bool:
    """Whether any body of a scene can touch another.

    Args:
        spec: the scene.

    Returns:
        True if some body has an entry `contact`.
    """
    return any(body.friction is not None for body in spec.bodies)


def _prepare(spec: SceneSpec, starts: np.ndarray, num_steps: int) -> Program:
    if needs_contact(spec) and not HAS_CONTACT:
        raise NotExpressibleError("contact: not yet")
    scene, params = spec.scene, spec.params()
    wrenches = jnp.zeros((num_steps, spec.num_bodies, 3))
    start = state_from_array(jnp.asarray(starts))

    def all_worlds(scene, params, start, wrenches):
        return jax.vmap(lambda state: rollout(scene, params, state, wrenches))(start)

    return compiled_program(
        all_worlds,
        (scene, params, start, wrenches),
        lambda result: np.asarray(result[0].array, float),
    )


PEERS = (Peer("boomdp_jax", _prepare),)
