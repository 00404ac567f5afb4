"""What a task for planners is, and what the four tasks share."""

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.physics import State
from boomdp_jax.physics.scene_file import load_scene

NUM_LEAF_STEPS = 10.0
"""Steps for which a leaf's cost is taken to go on."""


class Task(NamedTuple):
    """A model, and how it is tried."""

    name: str
    transition_fn: Callable
    reward_fn: Callable
    actions: jax.Array
    hypothesis: Any
    """The true one."""
    leaves: dict[str, Callable]
    coordinates_fn: Callable
    cell_size: np.ndarray
    stratum_size: np.ndarray
    starts: Callable
    """Key to a state."""
    num_steps: int
    """Of an episode."""
    cost_bound: float
    """No step costs more, wherever a plan may lead; no leaf's single step either."""
    is_reached: Callable
    """State to whether the goal is reached, at the end of an episode."""
    action_repeat: int
    depth: int
    """Of the tree, in held actions."""
    action_repeats: tuple[int, ...]
    """Steps for which an action may be held, to choose from; they divide an episode."""


def scene_of(description: dict):
    """A scene from what its file would say."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "scene.json")
        path.write_text(json.dumps({"schema": "planar-scene-1", **description}))
        return load_scene(path)


def single_body(pose, twist) -> State:
    return State(jnp.asarray(pose)[None], jnp.asarray(twist)[None])


def wrapped(angle):
    """The same direction, between −π and π."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def within_circle(force, largest: float):
    """The same direction, no stronger than `largest`.

    Planners of continuous actions choose from a box, whose corners would be stronger
    than any listed action.
    """
    size = jnp.sqrt(jnp.sum(force**2) + 1e-12)
    return force * jnp.minimum(1.0, largest / size)
