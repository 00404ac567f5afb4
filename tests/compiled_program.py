"""What the compiler makes of physics and its gradient; saved to a file."""

import sys

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.physics import rollout
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict

NUM_WORLDS, NUM_STEPS = 16, 40


def cart() -> SceneSpec:
    """One body on a wheel and a floor that rubs."""
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, 0.0],
            "dt": 0.02,
            "bodies": [
                {
                    "name": "cart",
                    "shape": {"type": "box", "half_extents": [0.3, 0.2]},
                    "pose": [0.0, 0.0, 0.0],
                    "density": 20.0,
                }
            ],
            "constraints": [
                {
                    "type": "wheel",
                    "a": "cart",
                    "pose": [-0.2, 0.0, 0.0],
                    "viscous": [1.0, 30.0],
                    "dry": [2.0, 20.0],
                },
                {"type": "ground", "a": "cart", "dry": 0.1, "viscous": 2.0},
            ],
        },
        source="test",
    )


def numbers() -> dict[str, np.ndarray]:
    """States of many worlds after each step, and the gradient of one."""
    spec = cart()

    def states(force):
        wrenches = jnp.broadcast_to(
            jnp.array([1.0, 0.0, 0.1]) * force, (NUM_STEPS, 1, 3)
        )
        start = spec.initial_state()
        return rollout(spec.scene, spec.params(), start, wrenches)[0].array

    forces = jnp.linspace(10.0, 40.0, NUM_WORLDS)
    return {
        "states": np.asarray(jax.jit(jax.vmap(states))(forces)),
        "slope": np.asarray(jax.jit(jax.grad(lambda f: jnp.sum(states(f))))(25.0)),
    }


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    np.savez(sys.argv[1], **numbers())
