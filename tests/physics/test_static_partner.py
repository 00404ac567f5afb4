"""A joint with a static body is one with the world at the same place."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics import rollout, scene_spec_from_dict


def _swing(partner: str, kind: str):
    """A bar that swings from a post or, at the same point, from the world."""
    joint = {"type": kind, "a": "bar", "b": partner, "anchor_a": [-0.5, 0.0]}
    joint["anchor_b"] = [0.1, 0.2] if partner == "post" else [0.1, 1.2]
    place = 0.6
    if kind == "distance":
        joint["length"], place = 0.3, 0.9
    spec = scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, -9.81],
            "dt": 0.01,
            "bodies": [
                {
                    "name": "bar",
                    "pose": [place, 1.2, 0.0],
                    "shape": {"type": "box", "half_extents": [0.5, 0.05]},
                    "density": 20.0,
                },
                {
                    "name": "post",
                    "pose": [0.0, 1.0, 0.0],
                    "shape": {"type": "box", "half_extents": [0.1, 0.1]},
                    "static": True,
                },
            ],
            "constraints": [joint],
        }
    )
    states, info = jax.jit(rollout)(
        spec.scene, spec.params(), spec.initial_state(), jnp.zeros((100, 2, 3))
    )
    return np.asarray(states.pose), np.asarray(info.constraint_error)


@pytest.mark.parametrize("kind", ["revolute", "distance"])
@pytest.mark.slow
def test_joint_with_a_static_body_is_one_with_the_world(kind):
    pose, error = _swing("post", kind)
    expected, _ = _swing("world", kind)
    assert np.allclose(pose, expected, atol=1e-9)
    assert np.max(error) < 1e-4
    assert np.all(pose[:, 1] == [0.0, 1.0, 0.0])
