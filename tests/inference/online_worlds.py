"""A box whose world may change half-way, seen through noise, one row after another."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.history import History, make_history
from boomdp_jax.physics import State, step
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict
from boomdp_jax.physics.state import state_from_array

DT, DENSITY = 0.02, 12.5
MASS = DENSITY * 0.6 * 0.4
NOISE = np.array([1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 5e-3])
ANCHOR = (0.2, 0.1)
LATERAL, ROLLING = 180.0, 5.0


class Rows(NamedTuple):
    """Readings of one body, `[time, 6]`, and wrenches `[time, 3]`."""

    state: np.ndarray
    action: np.ndarray
    next_state: np.ndarray

    def to_history(self, capacity: int | None = None) -> History:
        """As a table."""
        return make_history(*(part[:, None] for part in self), DT, capacity=capacity)

    def transition(self, index: int) -> tuple[State, jax.Array, State]:
        """One row as `OnlineBelief.step` takes it."""
        parts = [jnp.asarray(part[index][None], float) for part in self]
        return state_from_array(parts[0]), parts[1], state_from_array(parts[2])


EVERYTHING = {"revolute": 1, "wheel": 1, "ground": 1}


def box_world(
    constraints: list[dict],
    *,
    is_hidden: bool = False,
    unknown: dict[str, int] = EVERYTHING,
) -> SceneSpec:
    """The box seen from above; hidden, its density is unknown, too."""
    body = {
        "name": "box",
        "shape": {"type": "box", "half_extents": [0.3, 0.2]},
        "pose": [0, 0, 0],
    }
    if not is_hidden:
        body["density"] = DENSITY
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, 0.0],
            "normal_gravity": 9.81,
            "dt": DT,
            "bodies": [body],
            "constraints": constraints,
            "unknown": unknown,
        },
        source="test",
    )


def pinned(pose: np.ndarray) -> list[dict]:
    """A pin where the body stands."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    place = [
        pose[0] + cos * ANCHOR[0] - sin * ANCHOR[1],
        pose[1] + sin * ANCHOR[0] + cos * ANCHOR[1],
    ]
    return [
        {
            "type": "revolute",
            "a": "box",
            "b": "world",
            "anchor_a": list(ANCHOR),
            "anchor_b": [float(x) for x in place],
        }
    ]


def wheeled(rolling: float) -> list[dict]:
    """A wheel; locked where it rolls as hardly as it slides."""
    return [
        {
            "type": "wheel",
            "a": "box",
            "pose": [-0.15, 0.0, 0.0],
            "viscous": [rolling, LATERAL],
        }
    ]


def world_of(name: str, pose: np.ndarray) -> list[dict]:
    """Constraints by name."""
    if name == "pinned":
        return pinned(pose)
    return {"free": [], "cart": wheeled(ROLLING), "locked": wheeled(LATERAL)}[name]


def simulate(seed: int, names: list[str]) -> Rows:
    """Push the box about; each row happens in the world of that name."""
    rng = np.random.default_rng(seed)
    num = len(names)
    times = np.arange(num) * DT
    phase = rng.uniform(0, 2 * np.pi, (3, 3))
    rate = rng.uniform(4.0, 14.0, (3, 3))
    waves = np.sin(times[:, None, None] * rate + phase).sum(axis=-1)
    action = waves * np.array([8.0, 8.0, 1.5])
    now, states = np.zeros(6), [np.zeros(6)]
    before, advance = "", None
    for index, name in enumerate(names):
        if name != before:
            spec, before = box_world(world_of(name, now)), name
            scene, params = spec.scene, spec.params()
            advance = jax.jit(
                lambda s, w, scene=scene, params=params: (
                    step(scene, params, state_from_array(s), w)[0].array
                )
            )
        now = np.asarray(
            advance(jnp.asarray(now[None], float), jnp.asarray(action[index][None]))
        )[0]
        states.append(now)
    read = np.array(states) + NOISE * rng.standard_normal((num + 1, 6))
    return Rows(read[:-1], action, read[1:])
