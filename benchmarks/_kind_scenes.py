"""Rooms with several objects of a few kinds, half of which were pushed."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.history import History, make_history
from boomdp_jax.physics import Params, State, rollout
from boomdp_jax.physics.params import WORLD, empty_params
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict

KINDS = ("light box", "heavy box", "cart", "pinned table")
NOISE = np.array([1e-3, 1e-3, 1e-3, 4e-3, 4e-3, 4e-3])
"""Sd of readings: 1 mm, 1 mrad, 4 mm/s, 4 mrad/s."""
_DT = 0.04
_SPREAD = 0.05
"""Relative spread of densities, friction and sizes within a kind."""
_SIZES = {
    "light box": (0.15, 0.15),
    "heavy box": (0.30, 0.20),
    "cart": (0.35, 0.15),
    "pinned table": (0.40, 0.30),
}
_DENSITY = {"light box": 8.0, "heavy box": 60.0, "cart": 20.0, "pinned table": 30.0}
_FRICTION = {"light box": 0.25, "heavy box": 0.45, "pinned table": 0.2}


class Room(NamedTuple):
    """Truth, what a learner sees, and what happened."""

    truth: SceneSpec
    seen: SceneSpec
    history: History
    kind: np.ndarray
    """Of each body, an index of `KINDS`."""
    is_pushed: np.ndarray


def make_room(
    rng: np.random.Generator,
    num_bodies: int,
    num_rows: int,
    *,
    with_outlines: bool,
    with_labels: bool,
) -> Room:
    """Draw a room and push every other object of each kind.

    Args:
        rng: source of randomness.
        num_bodies: objects, a quarter of each kind.
        num_rows: transitions of each object that is pushed.
        with_outlines: whether the kinds differ in size and shape.
        with_labels: whether the scene says what they look like.
    """
    kind = np.arange(num_bodies) % len(KINDS)
    bodies, constraints = [], []
    for i in range(num_bodies):
        body, several = _draw_body(rng, i, KINDS[kind[i]], with_outlines, with_labels)
        bodies.append(body)
        constraints += several
    content = {
        "schema": "planar-scene-1",
        "gravity": [0.0, 0.0],
        "dt": _DT,
        "bodies": bodies,
        "constraints": constraints,
    }
    truth = scene_spec_from_dict(content, source="room")
    hidden = [{k: v for k, v in b.items() if k != "density"} for b in bodies]
    unknown = {"revolute": 1, "wheel": 1, "ground": 1}
    seen = scene_spec_from_dict(
        content | {"bodies": hidden, "constraints": [], "unknown": unknown},
        source="room",
    )
    is_pushed = (np.arange(num_bodies) // len(KINDS)) % 2 == 0
    wrench = draw_pushes(rng, truth, num_rows) * is_pushed[:, None]
    states = run(truth, wrench)
    reading = states + NOISE * rng.standard_normal(states.shape)
    history = make_history(reading[:-1], wrench, reading[1:], _DT)
    return Room(truth, seen, history, kind, is_pushed)


def _draw_body(rng, i: int, kind: str, with_outlines: bool, with_labels: bool):
    def vary(value):
        return float(value * np.exp(_SPREAD * rng.standard_normal()))

    half = [vary(x) for x in _SIZES[kind]]
    if not with_outlines:
        half = list(rng.uniform(0.15, 0.4, 2))
    name = f"object {i}"
    # Far enough from each other for nothing to touch.
    place = [3.0 * (i % 5), 3.0 * (i // 5), float(rng.uniform(-np.pi, np.pi))]
    body = {
        "name": name,
        "shape": {"type": "box", "half_extents": half},
        "pose": place,
        "density": vary(_DENSITY[kind]),
    }
    if with_labels:
        body["label"] = kind
    mass = body["density"] * 4.0 * half[0] * half[1]
    several = []
    if kind == "cart":
        pose = [-0.6 * half[0], 0.0, 0.02 * rng.standard_normal()]
        lateral = vary(80.0) * mass
        several.append(
            {
                "type": "wheel",
                "a": name,
                "pose": pose,
                "viscous": [vary(0.03) * lateral, lateral],
            }
        )
    else:
        several.append({"type": "ground", "a": name, "dry": vary(_FRICTION[kind])})
    if kind == "pinned table":
        arm = np.array([0.7 * half[0], 0.7 * half[1]]) + 0.01 * rng.standard_normal(2)
        cos, sin = np.cos(place[2]), np.sin(place[2])
        world = place[:2] + np.array([[cos, -sin], [sin, cos]]) @ arm
        several.append(
            {
                "type": "revolute",
                "a": name,
                "b": "world",
                "anchor_a": arm.tolist(),
                "anchor_b": world.tolist(),
            }
        )
    return body, several


def draw_pushes(rng, truth: SceneSpec, num_rows: int) -> np.ndarray:
    """Pushes that every object answers at walking pace, `[time, body, 3]`.

    Each lasts a third of the time, in a random direction and at a random arm.
    """
    params, scene = truth.params(), truth.scene
    mass = np.asarray(params.density * scene.area)
    friction = np.asarray(params.ground.dry).max(axis=1, initial=0.0)
    length = max(num_rows // 3, 1)
    num = -(-num_rows // length)
    turn = rng.uniform(-np.pi, np.pi, (num, len(mass)))
    size = mass * (9.81 * friction + 2.5) * rng.uniform(0.7, 1.3, turn.shape)
    reach = np.array([body.reach for body in truth.bodies])
    arm = rng.uniform(-0.5, 0.5, turn.shape) * reach
    wrench = np.stack([np.cos(turn), np.sin(turn), arm], -1) * size[..., None]
    return np.repeat(wrench, length, axis=0)[:num_rows]


def run(truth: SceneSpec, wrench: np.ndarray) -> np.ndarray:
    """True states from rest, the first one included, `[time + 1, body, 6]`."""
    start = np.concatenate([truth.pose, np.zeros_like(truth.pose)], axis=-1)
    params = jax.tree.map(lambda leaf: np.asarray(leaf)[None], truth.params())
    return np.concatenate([start[None], predict(truth, params, wrench)[0]])


def predict(spec: SceneSpec, params: Params, wrench: np.ndarray) -> np.ndarray:
    """States from rest under every hypothesis, `[draw, time, body, 6]`.

    Bodies do not touch, so that each is a scene of its own: one small program serves
    them all, where that of the whole room would take a minute to compile.
    """
    parts = []
    for i, body in enumerate(spec.bodies):
        content = spec.to_dict() | {"constraints": [], "unknown": {}, "prior": {}}
        content["bodies"] = [content["bodies"][i]]
        scene = scene_spec_from_dict(content, source=body.name).scene
        start = jnp.asarray(spec.pose[i : i + 1], float)
        push = jnp.asarray(wrench[:, i : i + 1], float)
        parts.append(np.asarray(_roll(scene, lone_params(params, i), start, push)))
    return np.concatenate(parts, axis=2)


@jax.jit
def _roll(scene, params: Params, pose, wrench):
    start = State(pose, jnp.zeros_like(pose))
    return jax.vmap(lambda params: rollout(scene, params, start, wrench)[0].array)(
        params
    )


def lone_params(params: Params, body: int) -> Params:
    """What hypotheses say of one body, as a scene of its own with a slot of each kind.

    Args:
        params: of a room, with a leading draw axis.
        body: which body.
    """
    density = np.asarray(params.density)
    num = len(density)
    lone = empty_params(1, num_revolute=1, num_wheel=1, num_ground=1)
    owner = np.flatnonzero(np.asarray(params.revolute.body_a)[0] == body)
    out = {"density": jnp.asarray(density[:, body : body + 1], float)}
    for kind in ("revolute", "wheel", "ground"):
        group, template = getattr(params, kind), getattr(lone, kind)
        is_joint = kind == "revolute"
        fields = {}
        for name, empty in vars(template).items():
            value = getattr(group, name)
            if name in ("limit", "motor"):
                continue
            if name in ("body_a", "body_b"):
                fields[name] = jnp.full((num, 1), 0 if name == "body_a" else WORLD)
                continue
            if value is None and empty is None:
                continue  # What the law has by itself, which is not zero.
            if empty is None:
                empty = np.zeros((1, 1, *value.shape[3:]))
            empty = np.asarray(empty)
            whole = np.broadcast_to(empty, (num, *empty.shape))
            if value is not None and is_joint and len(owner):
                whole = np.asarray(value)[:, owner[:1]]
            elif value is not None and not is_joint and np.asarray(value).shape[2]:
                whole = np.asarray(value)[:, body : body + 1, :1]
            fields[name] = jnp.asarray(whole)
        out[kind] = type(template)(**fields)
    nothing = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (num, *leaf.shape)), lone.distance
    )
    return Params(distance=nothing, **out)
