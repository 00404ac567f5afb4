"""One scene of the accuracy suite: how it starts, how long it runs, who judges it."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from _peers_program import Figure

from boomdp_jax.physics.params import WORLD
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict

DT = 1.0 / 60.0
GRAVITY = 9.81


@dataclasses.dataclass(frozen=True)
class Case:
    """A scene with a known answer."""

    name: str
    spec: SceneSpec
    num_steps: int
    judge: Callable[[np.ndarray], list[Figure]]
    """From states after each step `[time, body, 6]` to errors."""
    stand_ins: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Paths of theories, judged like an engine's."""
    in_quick: bool = True
    """Whether a quick run has time for it, compilation included."""

    @property
    def start(self) -> np.ndarray:
        """Poses and twists at the start, `[body, 6]`."""
        twist = [body.twist for body in self.spec.bodies]
        return np.concatenate([self.spec.pose, twist], axis=1)


def box(name: str, half_extents, state: Sequence[float] = (0.0,) * 6, **fields) -> dict:
    """A box of a scene file.

    Args:
        name: its name.
        half_extents: half of its sides [m].
        state: pose and twist.
        fields: other entries; a density of 20 kg/m² unless given.

    Returns:
        An entry of `bodies`.
    """
    shape = {"type": "box", "half_extents": list(half_extents)}
    return _body(name, shape, state, fields)


def ball(name: str, radius: float, state: Sequence[float], **fields) -> dict:
    """A disc of a scene file; see `box`."""
    return _body(name, {"type": "circle", "radius": radius}, state, fields)


def _body(name: str, shape: dict, state: Sequence[float], fields: dict) -> dict:
    numbers = [float(number) for number in state]
    return {
        "name": name,
        "shape": shape,
        "pose": numbers[:3],
        "twist": numbers[3:],
        "density": 20.0,
        **fields,
    }


def scene(bodies: list[dict], constraints: Sequence[dict] = (), gravity=(0.0, 0.0)):
    """Read a scene at 60 Hz.

    Args:
        bodies: entries of its file.
        constraints: likewise.
        gravity: in the plane [m/s²].

    Returns:
        The scene.
    """
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [float(number) for number in gravity],
            "dt": DT,
            "bodies": bodies,
            "constraints": list(constraints),
        }
    )


def pin(a: str, anchor_a, b: str = "world", anchor_b=(0.0, 0.0)) -> dict:
    """A revolute joint of a scene file, at anchors in the bodies' frames [m]."""
    anchors = {"anchor_a": list(anchor_a), "anchor_b": list(anchor_b)}
    return {"type": "revolute", "a": a, "b": b, **anchors}


def pin_drift(spec: SceneSpec, states: np.ndarray) -> Figure:
    """How far any pin comes apart.

    Args:
        spec: the scene.
        states: poses and twists, `[time, body, 6]`.

    Returns:
        The largest distance.
    """
    worst = 0.0
    for joint in spec.constraints:
        if joint.kind == "revolute":
            gap = _place(states, joint.body_a, joint.numbers["anchor_a"]) - _place(
                states, joint.body_b, joint.numbers["anchor_b"]
            )
            worst = np.maximum(worst, np.hypot(gap[:, 0], gap[:, 1]).max())
    return Figure("pin drift", 1e3 * float(worst), "mm")


def _place(states: np.ndarray, body: int, anchor: np.ndarray) -> np.ndarray:
    """Where an anchor is in the world, `[time, 2]`."""
    if body == WORLD:
        return np.broadcast_to(anchor, (len(states), 2))
    own = states[:, body]
    cos, sin = np.cos(own[:, 2]), np.sin(own[:, 2])
    turn = np.stack([cos, -sin, sin, cos], axis=1).reshape(-1, 2, 2)
    return own[:, :2] + turn @ anchor


def angle_error(angle, expected) -> float:
    """Largest difference of angles, up to whole turns [rad]."""
    difference = np.asarray(angle) - np.asarray(expected)
    return float(np.abs(np.angle(np.exp(1j * difference))).max())


def place_error(states: np.ndarray, expected: np.ndarray) -> Figure:
    """Largest distance of a centre of mass from where it ought to be.

    Args:
        states: poses and twists, `[..., 6]`.
        expected: the right ones.

    Returns:
        The distance.
    """
    gap = states[..., :2] - expected[..., :2]
    return Figure("place", 1e3 * float(np.hypot(gap[..., 0], gap[..., 1]).max()), "mm")


def velocity_error(states: np.ndarray, expected: np.ndarray) -> Figure:
    """Largest error of a velocity of a centre of mass; see `place_error`."""
    gap = states[..., 3:5] - expected[..., 3:5]
    return Figure("velocity", float(np.hypot(gap[..., 0], gap[..., 1]).max()), "m/s")
