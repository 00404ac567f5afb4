"""Discs and boxes that stand on a floor in some way and are pushed until they slip."""

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.history import History, make_history
from boomdp_jax.interop.object_families import random_pushes
from boomdp_jax.interop.recording import READING_NOISE
from boomdp_jax.physics import rollout
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict

STANCES = (
    "all of it",
    "four legs",
    "four legs, told",
    "legs that rock",
    "legs that rock, told",
    "legs under a part",
    "rim",
    "three legs",
)
_DT, _NUM_ROWS = 0.02, 60
_NOISE = np.array(READING_NOISE)[[0, 0, 1, 2, 2, 3]]
_CORNERS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


def points_of(
    kind: str, stance: str, half: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Where the load rests, in equal parts, about the middle of the outline [m]."""
    share = rng.uniform(0.5, 0.95)
    turn = rng.uniform(0.0, 2.0 * np.pi)
    if stance == "three legs":
        angle = turn + np.arange(3) / 3 * 2 * np.pi
        return share * half * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if "legs" in stance:
        corners = _CORNERS / np.sqrt(2) if kind == "circle" else _CORNERS
        uneven = rng.uniform(0.5, 0.95, 2) if stance.endswith("part") else share
        return uneven * half * corners
    if stance == "rim":
        if kind == "circle":
            angle = np.arange(64) / 64 * 2 * np.pi
            return 0.97 * half * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        side = (np.arange(16) + 0.5) / 8 - 1
        flat, one = np.stack([side, np.ones(16)], axis=1), np.array([1.0, -1.0])
        sides = [flat, flat * one, flat[:, ::-1], flat[:, ::-1] * one[::-1]]
        return 0.97 * half * np.concatenate(sides)
    if kind == "circle":
        number = np.arange(64) + 0.5
        radius, angle = np.sqrt(number / 64), np.pi * (1 + 5**0.5) * number
        points = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:
        side = (np.arange(8) + 0.5) / 4 - 1
        points = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    return half * (points - points.mean(axis=0))


def scene(outline: dict, feet: np.ndarray | None, **known: float) -> SceneSpec:
    """Scene of the one object, its numbers known or all to be found."""
    body = {"name": "object", "shape": outline, "pose": [0.1, -0.2, 0.3]}
    if feet is not None:
        body["feet"] = feet.tolist()
    content: dict = {"schema": "planar-scene-1", "dt": _DT}
    if known:
        body["density"] = known["density"]
        floor = {"type": "ground", "a": "object", "dry": known["dry"]}
        content["constraints"] = [floor]
    else:
        content["unknown"] = {"revolute": 1, "wheel": 1, "ground": 1}
    return scene_spec_from_dict(content | {"bodies": [body]})


def pushed_object(
    seed: list[int], stance: str
) -> tuple[SceneSpec, History, dict[str, float]]:
    """What is told of an object, its readings, and what is true of it."""
    rng = np.random.default_rng(seed)
    half = np.sort(rng.uniform(0.1, 0.4, 2))[::-1]
    kind = "box" if seed[-1] % 2 else "circle"
    if kind == "box":
        outline = {"type": "box", "half_extents": half.tolist()}
        area, reach = 4 * half[0] * half[1], float(np.hypot(*half))
    else:
        half = np.full(2, half[1])
        outline = {"type": "circle", "radius": half[0]}
        area, reach = np.pi * half[0] ** 2, half[0]
    legs = feet = points_of(kind, stance, half, rng)
    if "rock" in stance:
        # Points that coincide carry their shares together: legs of the second diagonal
        # carry up to 7/3 of what those of the first one do.
        more = np.repeat(legs[1::2], 3 + seed[-1] % 5, axis=0)
        feet = np.concatenate([np.repeat(legs[::2], 3, axis=0), more])
    density = float(np.exp(rng.uniform(np.log(5.0), np.log(100.0))))
    dry = float(np.exp(rng.uniform(np.log(0.1), np.log(0.6))))
    truth = scene(outline, feet, density=density, dry=dry)
    force, _ = random_pushes(rng, _NUM_ROWS, 1, reach)
    force = force * density * area * 9.81 * dry * rng.uniform(1.5, 4.0)
    start = truth.initial_state()
    states, _ = jax.jit(rollout)(
        truth.scene, truth.params(), start, jnp.asarray(force)[:, None]
    )
    read = np.concatenate([np.asarray(start.array)[None], np.asarray(states.array)])
    read = read + _NOISE * rng.normal(size=read.shape)
    history = make_history(read[:-1], force[:, None], read[1:], _DT)
    told = legs if stance.endswith("told") else None
    return scene(outline, told), history, {"mass": density * area, "friction": dry}
