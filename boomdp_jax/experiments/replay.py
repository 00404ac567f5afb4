"""An episode of a run as a trajectory to look at, among all that can be seen."""

import os
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.json_file import read_json
from boomdp_jax.core.npz_file import read_npz
from boomdp_jax.envs.namo_room import TIME_STEP, room_params, room_scene
from boomdp_jax.experiments.namo import make_room
from boomdp_jax.experiments.registry import make_task
from boomdp_jax.experiments.run import SCHEMA
from boomdp_jax.experiments.scores import check_is_run
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.physics.state import State

_LONGEST_INTERVAL = 0.1
"""Between two poses that are drawn [s]; longer steps are filled in straight."""


class Replay(NamedTuple):
    """What `viz.animate` is given."""

    spec: SceneSpec
    states: State
    """Leading axis `time`."""
    dt: float
    """Between two of them [s]."""
    params: Params | None
    """The world's; None: those of the scene."""
    title: str


def replay(folder: str | os.PathLike, seed: int | None = None) -> Replay:
    """Read an episode of a run.

    Args:
        folder: what `run --out` wrote.
        seed: which episode; default: the first that is there.

    Returns:
        It, from after the first step to the last one that was done.

    Raises:
        ValueError: a folder of something else, no such episode, or one that was over
            before it began.
        OSError: it cannot be read.
    """
    folder = Path(folder)
    check_is_run(folder)
    content = read_json(folder / "run.json", SCHEMA)
    there = [
        number
        for number in range(content["num_seeds"])
        if (folder / f"seed-{number:05d}.npz").exists()
    ]
    if not there:
        raise ValueError(f"{folder}: expected at least one episode, got none yet")
    shown = there[0] if seed is None else seed
    if shown not in there:
        raise ValueError(
            f"{folder}: --episode: expected one of {there[0]} to {there[-1]} that is "
            f"done, got {shown}"
        )
    record = read_npz(folder / f"seed-{shown:05d}.npz")
    if content["task"] == "namo":
        return _replay_room(content, record["poses"], shown)
    states = record["state"][record["action"] >= 0]
    if not len(states):
        raise ValueError(f"{folder}: episode {shown}: expected a step, got none")
    task = make_task(content["task"], content["num_steps"], content.get("world"))
    _, others = task.surroundings
    others = np.broadcast_to(np.asarray(others), (len(states), *others.shape))
    poses = np.concatenate([states[..., :3], others], axis=1)
    dt = float(task.spec.dt)
    num_parts = int(np.ceil(dt / _LONGEST_INTERVAL - 1e-9))
    poses = _filled_in(poses, num_parts)
    return Replay(
        task.seen_spec,
        State(jnp.asarray(poses, float), jnp.zeros(poses.shape)),
        dt / num_parts,
        task.default_params().physics if task.seen_spec is task.spec else None,
        f"{content['task']}, {content['agent']}, episode {shown}",
    )


def _replay_room(content: dict, poses: np.ndarray, seed: int) -> Replay:
    """A robot among furniture."""
    room = make_room(
        content["room"], seed, content["num_things"], content["difficulty"]
    )
    spec = room_scene(room)
    return Replay(
        spec,
        State(jnp.asarray(poses, float), jnp.zeros(poses.shape)),
        TIME_STEP,
        room_params(room, spec),
        f"namo, {content['agent']}, room {seed}",
    )


def _filled_in(poses: np.ndarray, num_parts: int) -> np.ndarray:
    """Poses between those of steps, on straight lines."""
    times = np.arange(len(poses) * 1.0)
    wanted = np.linspace(0.0, times[-1], (len(poses) - 1) * num_parts + 1)
    flat = poses.reshape(len(poses), -1)
    columns = [np.interp(wanted, times, column) for column in flat.T]
    return np.stack(columns, axis=-1).reshape(-1, *poses.shape[1:])
