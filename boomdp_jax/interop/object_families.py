"""Random unknown objects of a few families, and pushes that suit them.

Every object is a scene with one body of which everything is known; `hide` makes the
scene that a learner gets to see. All objects have the same capacities, so that one
compiled call serves any mixture of them.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from boomdp_jax.core.transition_table import TransitionTable
from boomdp_jax.interop.mjcf import RecordingLaws
from boomdp_jax.interop.recording import record
from boomdp_jax.physics.params import WORLD
from boomdp_jax.physics.scene_spec import (
    SCENE_SCHEMA,
    STANDARD_GRAVITY,
    SceneSpec,
    scene_spec_from_dict,
)

FAMILIES = (
    "box",
    "table",
    "cart",
    "pendulum",
    "dry cart",
    "floor box",
    "floor table",
)
"""Free; pinned; on a fixed wheel with viscous friction; hung in a vertical plane; on a
fixed wheel that slips at a limit; free and pinned with friction of the floor."""

UNKNOWN = {"revolute": 1, "distance": 0, "wheel": 1, "ground": 1}
"""What a learner must reckon with, whatever the family."""

_DT = 0.02
_TARGET_SPEED = 0.45
"""Root mean square speed of the fastest part of an object, middle of 0.2 to 1 m/s."""


def random_object(rng: np.random.Generator, family: str) -> SceneSpec:
    """Draw an object of a family.

    Args:
        rng: source of randomness.
        family: one of `FAMILIES`.

    Returns:
        The true scene: a box with density log-uniform over 5 to 100 kg/m², whose
        constraints are all known.

    Raises:
        ValueError: no such family.
    """
    if family not in FAMILIES:
        raise ValueError(f"family: expected one of {', '.join(FAMILIES)}, got {family}")
    half = np.sort(rng.uniform(0.1, 0.4, 2))[::-1]
    density = float(np.exp(rng.uniform(np.log(5.0), np.log(100.0))))
    mass = density * 4.0 * half[0] * half[1]
    gravity, normal, constraints = [0.0, 0.0], STANDARD_GRAVITY, []
    pose = [*rng.uniform(-0.5, 0.5, 2), rng.uniform(-np.pi, np.pi)]
    if family == "pendulum":
        half = rng.uniform(0.05, 0.12, 2)
        gravity, normal = [0.0, -9.81], 0.0
        direction = rng.uniform(-np.pi, np.pi)
        anchor = rng.uniform(0.3, 0.8) * np.array(
            [np.cos(direction), np.sin(direction)]
        )
        constraints.append(_pin(anchor, rng.uniform(-0.5, 0.5, 2)))
    elif family.endswith("table"):
        anchor = rng.uniform(-0.9, 0.9, 2) * half
        constraints.append(_pin(anchor, rng.uniform(-0.5, 0.5, 2)))
    elif family.endswith("cart"):
        place = rng.uniform(-0.9, 0.9, 2) * half
        wheel = {
            "type": "wheel",
            "a": "object",
            "pose": [*place, rng.uniform(-np.pi / 2, np.pi / 2)],
        }
        ratio = np.exp(rng.uniform(np.log(0.01), np.log(0.1)))
        if family == "dry cart":
            lateral = mass * STANDARD_GRAVITY * rng.uniform(0.3, 1.0)
            wheel["dry"] = [ratio * lateral, lateral]
        else:
            lateral = mass * np.exp(np.log(60.0) + 0.6 * rng.standard_normal())
            wheel["viscous"] = [ratio * lateral, lateral]
        constraints.append(wheel)
    if family.startswith("floor"):
        friction = float(np.exp(rng.uniform(np.log(0.1), np.log(0.6))))
        constraints.append({"type": "ground", "a": "object", "dry": friction})
    return _build(half, density, pose, gravity, normal, constraints)


def hide(truth: SceneSpec) -> SceneSpec:
    """Make the scene that a learner sees: outline, gravity, and what may exist.

    Args:
        truth: scene of which everything is known.

    Returns:
        The same without densities and constraints.
    """
    content = truth.to_dict()
    for body in content["bodies"]:
        body.pop("density", None)
    content["constraints"] = []
    content["unknown"] = dict(UNKNOWN)
    return scene_spec_from_dict(content, source="hidden object")


def random_pushes(
    rng: np.random.Generator, num_rows: int, num_episodes: int, reach: float
) -> tuple[Float[np.ndarray, "time 3"], Int[np.ndarray, " time"]]:
    """Draw smooth pushes of unit force with pauses between them.

    Each push rises and falls as a squared sine over 0.12 to 0.5 s, in a random
    direction and at a random arm; every other time or so a pause follows.

    Args:
        rng: source of randomness.
        num_rows: steps in all.
        num_episodes: runs that they are shared out to, evenly.
        reach: largest arm of the force about the centre of mass [m].

    Returns:
        Wrenches of forces of at most 1 N, and the run that each row belongs to.
    """
    wrenches = np.zeros((num_rows, 3))
    row = 0
    while row < num_rows:
        length = int(rng.integers(6, 26))
        rise = np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 2
        direction = rng.uniform(-np.pi, np.pi)
        strength, arm = rng.uniform(0.4, 1.0), rng.uniform(-reach, reach)
        push = strength * np.array([np.cos(direction), np.sin(direction), arm])
        span = wrenches[row : row + length]
        span += (rise[:, None] * push)[: len(span)]
        row += length
        if rng.random() < 0.5:
            row += int(rng.integers(3, 15))
    episode = (np.arange(num_rows) * num_episodes) // num_rows
    return wrenches, episode


def record_random_pushes(
    rng: np.random.Generator,
    truth: SceneSpec,
    num_rows: int,
    *,
    num_episodes: int = 4,
    laws: RecordingLaws | None = None,
) -> TransitionTable:
    """Push an object so that it moves at walking pace, and record it.

    Pushes are scaled by a few trial recordings until the fastest part of the object
    moves at about 0.45 m/s, root mean square. A body hung in a vertical plane starts
    at rest below its pin, all others at a random angle.

    Args:
        rng: source of randomness.
        truth: scene with one body, of which everything is known.
        num_rows: transitions.
        num_episodes: runs from rest that they are shared out to.
        laws: which of MuJoCo's elements stand for the constraints.

    Returns:
        The table of true states.
    """
    laws = RecordingLaws() if laws is None else laws
    body = truth.bodies[0]
    wrenches, episode = random_pushes(rng, num_rows, num_episodes, body.reach)
    start = np.column_stack(
        [
            rng.uniform(-0.5, 0.5, (num_episodes, 2)),
            _start_angles(rng, truth, num_episodes),
        ]
    )
    start = start[np.unique(episode)]
    options = {"episode": episode, "start": start}
    trial = dataclasses.replace(laws, time_step=0.001)
    strength, low, high = _first_guess(truth), 0.0, np.inf
    for _ in range(8):
        table = record(truth, strength * wrenches, laws=trial, **options)
        speed = np.hypot(table.next_state[..., 3], table.next_state[..., 4])
        speed = speed + body.reach * np.abs(table.next_state[..., 5])
        ratio = _TARGET_SPEED / max(float(np.sqrt(np.mean(speed**2))), 1e-3)
        if 0.7 < ratio < 1.4:
            break
        # Dry friction makes the response steep, so that bisection takes over.
        low, high = (strength, high) if ratio > 1 else (low, strength)
        strength *= float(np.clip(ratio, 0.3, 3.0))
        if not low < strength < high:
            strength = np.sqrt(low * high)
    return record(truth, strength * wrenches, laws=laws, **options)


def _pin(anchor: np.ndarray, point: np.ndarray) -> dict:
    return {
        "type": "revolute",
        "a": "object",
        "b": "world",
        "anchor_a": [float(x) for x in anchor],
        "anchor_b": [float(x) for x in point],
    }


def _build(half, density, pose, gravity, normal, constraints) -> SceneSpec:
    body = {
        "name": "object",
        "shape": {"type": "box", "half_extents": [float(x) for x in half]},
        "pose": [float(x) for x in pose],
        "density": density,
    }
    content = {
        "schema": SCENE_SCHEMA,
        "gravity": gravity,
        "normal_gravity": normal,
        "dt": _DT,
        "bodies": [body],
        "constraints": constraints,
        "unknown": dict(UNKNOWN),
    }
    return scene_spec_from_dict(content, source="random object")


def _start_angles(
    rng: np.random.Generator, truth: SceneSpec, num: int
) -> Float[np.ndarray, " episode"]:
    """Random, but hanging straight down where gravity pulls at a pinned body."""
    pins = [c for c in truth.constraints if c.kind == "revolute" and c.body_b == WORLD]
    if not pins or not np.any(truth.gravity):
        return rng.uniform(-np.pi, np.pi, num)
    to_centre = -pins[0].numbers["anchor_a"]
    down = np.arctan2(truth.gravity[1], truth.gravity[0])
    return np.full(num, down - np.arctan2(to_centre[1], to_centre[0]))


def _first_guess(truth: SceneSpec) -> float:
    """Force that accelerates the object to speed in a quarter of a second [N]."""
    body = truth.bodies[0]
    mass = float(truth.params().density[0]) * body.area
    dry = [c.numbers["dry"] for c in truth.constraints if c.kind == "ground"]
    limit = sum(float(d) for d in dry if np.isfinite(d)) * truth.normal_gravity
    return mass * (4.0 * _TARGET_SPEED + 2.0 * limit)
