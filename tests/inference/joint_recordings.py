"""A box in a drawer, fixed, hinged or free on the floor, and noisy recordings of it."""

import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.history import History, make_history
from boomdp_jax.physics import State, rollout
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict

DT, NUM_ROWS, NUM_EPISODES = 0.05, 40, 4
HALF, DENSITY = (0.3, 0.2), 30.0
POSE = np.array([0.3, 0.2, 0.4])
AXIS = 0.7
HINGE = np.array([-0.27, 0.15])
NOISE = np.array([1e-3, 1e-3, 1e-3, 4e-3, 4e-3, 4e-3])
"""Sd of readings: 1 mm, 1 mrad, 4 mm/s, 4 mrad/s."""
UNKNOWN = {"revolute": 1, "prismatic": 1, "weld": 1, "ground": 1}


def turned(angle: float, vector: np.ndarray) -> np.ndarray:
    """A vector turned by an angle."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]]) @ vector


def joint(kind: str, **numbers) -> dict:
    """A constraint of the box to the world, as a scene file has it."""
    return {"type": kind, "a": "box", "b": "world", **numbers}


CONSTRAINTS = {
    "drawer": joint(
        "prismatic",
        anchor_a=[0.0, 0.0],
        anchor_b=POSE[:2].tolist(),
        axis=AXIS,
        angle=POSE[2],
        viscous=20.0,
        dry=3.0,
    ),
    "fixed": joint(
        "weld", anchor_a=[0.0, 0.0], anchor_b=POSE[:2].tolist(), angle=POSE[2]
    ),
    "door": joint(
        "revolute",
        anchor_a=HINGE.tolist(),
        anchor_b=(POSE[:2] + turned(POSE[2], HINGE)).tolist(),
        viscous=3.0,
        dry=0.5,
    ),
    "box": {"type": "ground", "a": "box", "dry": 0.2},
}
"""What holds each object."""

KINDS = {"drawer": "prismatic", "fixed": "weld", "door": "revolute", "box": "ground"}


def scene(
    *constraints: dict, unknown: dict | None = None, density: float | None = None
) -> SceneSpec:
    """The box, with constraints that are known."""
    body = {
        "name": "box",
        "shape": {"type": "box", "half_extents": list(HALF)},
        "pose": POSE.tolist(),
    }
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": DT,
            "bodies": [body if density is None else body | {"density": density}],
            "constraints": list(constraints),
            "unknown": unknown or {},
        },
        source="test",
    )


def recorded(
    name: str, seed: int = 0, *, num_episodes: int = NUM_EPISODES, noise: float = 1.0
) -> History:
    """Push and pull an object at some point, from rest, a few times."""
    rng = np.random.default_rng([seed, *name.encode()])
    truth = scene(CONSTRAINTS[name], density=DENSITY)
    params, spec_scene = truth.params(), truth.scene
    time = DT * (np.arange(NUM_ROWS) + 0.5)
    profile = np.sin(2.0 * np.pi * time / 2.0)
    states, wrenches = [], []
    for _ in range(num_episodes):
        direction = rng.uniform(-np.pi, np.pi)
        force = 25.0 * np.array([np.cos(direction), np.sin(direction)])
        arm = rng.uniform(-1.0, 1.0, 2) * HALF
        torque = arm[0] * force[1] - arm[1] * force[0]
        wrench = profile[:, None] * np.array([*force, torque])
        start = State(jnp.asarray(POSE)[None], jnp.zeros((1, 3)))
        run, _ = rollout(spec_scene, params, start, jnp.asarray(wrench)[:, None])
        state = np.concatenate([np.asarray(start.array)[None], np.asarray(run.array)])
        states.append(state[:, 0] + noise * NOISE * rng.normal(size=(NUM_ROWS + 1, 6)))
        wrenches.append(wrench)
    state = np.stack(states)
    return make_history(
        state[:, :-1].reshape(-1, 1, 6),
        np.reshape(wrenches, (-1, 1, 3)),
        state[:, 1:].reshape(-1, 1, 6),
        DT,
        episode=np.repeat(np.arange(num_episodes), NUM_ROWS),
    )
