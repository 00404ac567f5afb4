"""A pushed box that is pinned, or whose wheel locks, half-way through a recording."""

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.physics import step
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict
from boomdp_jax.physics.state import state_from_array

WORLDS = {"pinned": ("free", "pinned"), "wheel locks": ("cart", "locked")}
"""Before and after, by case."""

_DT, _DENSITY = 0.02, 12.5
MASS = _DENSITY * 0.6 * 0.4
_NOISE = np.array([1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 5e-3])
_ANCHOR, _LATERAL, _ROLLING = (0.2, 0.1), 180.0, 5.0


def box_scene(constraints: list[dict], density: float | None = None) -> SceneSpec:
    """The box seen from above, its density unknown unless given."""
    body = {
        "name": "box",
        "shape": {"type": "box", "half_extents": [0.3, 0.2]},
        "pose": [0, 0, 0],
        "density": density,
    }
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, 0.0],
            "normal_gravity": 9.81,
            "dt": _DT,
            "bodies": [body],
            "constraints": constraints,
            "unknown": {"revolute": 1, "wheel": 1, "ground": 1},
        },
        source="changing box",
    )


def recorded(seed: int, names: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Readings `[time + 1, 1, 6]` and wrenches `[time, 1, 3]`.

    Args:
        seed: of pushes and noise.
        names: the world in which each row happens.
    """
    rng = np.random.default_rng(seed)
    times = np.arange(len(names)) * _DT
    rate, phase = rng.uniform(4.0, 14.0, (3, 3)), rng.uniform(0, 2 * np.pi, (3, 3))
    waves = np.sin(times[:, None, None] * rate + phase).sum(axis=-1)
    action = (waves * np.array([8.0, 8.0, 1.5]))[:, None]
    now, states = np.zeros((1, 6)), [np.zeros((1, 6))]
    advance, before = None, ""
    for wrench, name in zip(action, names, strict=True):
        if advance is None or name != before:
            advance, before = _stepper(_constraints(name, now[0])), name
        now = np.asarray(advance(jnp.asarray(now, float), jnp.asarray(wrench, float)))
        states.append(now)
    truth = np.array(states)
    return truth + _NOISE * rng.standard_normal(truth.shape), action


def _stepper(constraints: list[dict]):
    spec = box_scene(constraints, _DENSITY)
    scene, params = spec.scene, spec.params()
    return jax.jit(lambda s, w: step(scene, params, state_from_array(s), w)[0].array)


def _constraints(name: str, pose: np.ndarray) -> list[dict]:
    """Of one world; a pin is put where the body stands."""
    if name == "free":
        return []
    if name == "pinned":
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        arm = np.array([[cos, -sin], [sin, cos]]) @ np.array(_ANCHOR)
        place = [float(x) for x in pose[:2] + arm]
        ends = {"anchor_a": list(_ANCHOR), "anchor_b": place}
        return [{"type": "revolute", "a": "box", "b": "world", **ends}]
    rolling = {"cart": _ROLLING, "locked": _LATERAL}[name]
    wheel = {"pose": [-0.15, 0.0, 0.0], "viscous": [rolling, _LATERAL]}
    return [{"type": "wheel", "a": "box", **wheel}]
