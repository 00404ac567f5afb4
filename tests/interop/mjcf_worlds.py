"""Scenes and MuJoCo runs that tests of documents share."""

import jax.numpy as jnp
import mujoco
import numpy as np

from boomdp_jax.physics import rollout
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict


def box(name, pose, half=(0.3, 0.1), **fields):
    """An entry of `bodies`."""
    shape = {"type": "box", "half_extents": list(half)}
    entry = {"name": name, "shape": shape, "pose": list(pose), "density": 20.0}
    return entry | fields


def ball(name, pose, radius=0.1, **fields):
    """An entry of `bodies`."""
    shape = {"type": "circle", "radius": radius}
    entry = {"name": name, "shape": shape, "pose": list(pose), "density": 20.0}
    return entry | fields


def joint(kind, a, b, anchor_a, anchor_b, **fields):
    """An entry of `constraints` that has a partner."""
    ends = {"anchor_a": list(anchor_a), "anchor_b": list(anchor_b)}
    return {"type": kind, "a": a, "b": b, **ends, **fields}


def scene(bodies, *constraints, gravity=(0.0, -9.81), dt=0.02, **fields) -> SceneSpec:
    """A scene of which everything is known."""
    content = {
        "schema": "planar-scene-1",
        "gravity": list(gravity),
        "dt": dt,
        "bodies": bodies,
        "constraints": list(constraints),
    }
    return scene_spec_from_dict(content | fields)


def placed(model, data, spec: SceneSpec) -> np.ndarray:
    """Pose of every body, by its name, headings modulo a turn."""
    poses = []
    for body in spec.bodies:
        matrix = data.body(body.name).xmat
        heading = np.arctan2(matrix[3], matrix[0])
        poses.append([*data.body(body.name).xpos[:2], heading])
    return np.array(poses)


def run_mujoco(text, spec: SceneSpec, num_steps, wrench=None) -> np.ndarray:
    """Poses after each of the scene's steps, from the document's key frame."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    num_ticks = round(spec.dt / model.opt.timestep)
    for index, body in enumerate(spec.bodies):
        if wrench is not None:
            data.body(body.name).xfrc_applied[[0, 1, 5]] = wrench[index]
    poses = []
    for _ in range(num_steps):
        mujoco.mj_step(model, data, num_ticks)
        mujoco.mj_forward(model, data)
        poses.append(placed(model, data, spec))
    return np.array(poses)


def run_ours(spec: SceneSpec, params, num_steps, wrench=None, dt=None) -> np.ndarray:
    """Poses after each step of the scene, in parts of `dt`."""
    parts = 1 if dt is None else round(spec.dt / dt)
    wrenches = np.zeros((num_steps * parts, spec.num_bodies, 3))
    if wrench is not None:
        wrenches += np.asarray(wrench, float)[None]
    states, _ = rollout(
        spec.scene, params, spec.initial_state(), jnp.asarray(wrenches), dt=dt
    )
    return np.asarray(states.pose)[parts - 1 :: parts]


def distance(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Largest difference of two paths [m, rad], headings modulo a turn."""
    difference = ours - theirs
    difference[..., 2] = np.angle(np.exp(1j * difference[..., 2]))
    return float(np.max(np.abs(difference)))
