"""A room with a gap in its wall, a box behind it, and a straight planner for it."""

import numpy as np

from boomdp_jax.envs import ArmScene, MobileArm, arm_scene
from boomdp_jax.planning import motion_points

FOLDED = np.array([-1.4, 0.2, 0.0, 1.4, -2.5])
ROBOT = MobileArm()
BOX_POSE = np.array([1.6, 0.6, 0.3])
HALF_GAP = 0.32
_SURFACE = {"friction": 0.3, "restitution": 0.0}


def room(*, density: float = 60.0) -> ArmScene:
    """Two walls with a gap between them, and a box that a pin may hold."""

    def wall(index: int, side: float) -> dict:
        return {
            "name": f"wall {index}",
            "static": True,
            "pose": [0.0, side * (HALF_GAP + 1.5), 0.0],
            "shape": {"type": "box", "half_extents": [0.1, 1.5]},
            "contact": _SURFACE,
        }

    box = {
        "name": "box",
        "pose": BOX_POSE.tolist(),
        "shape": {"type": "box", "half_extents": [0.2, 0.15]},
        "density": density,
        "contact": _SURFACE,
    }
    constraints = [
        {"type": "ground", "a": "box", "dry": 0.3},
        {
            "type": "revolute",
            "a": "box",
            "b": "world",
            "anchor_a": [0.0, 0.0],
            "anchor_b": BOX_POSE[:2].tolist(),
        },
    ]
    return arm_scene(ROBOT, FOLDED, [wall(0, 1.0), wall(1, -1.0), box], constraints)


def straight(
    seed, start, goals, is_free, lower, upper, *, levers, resolution, is_periodic=None
):
    """A planner that tries the straight way to each goal, and no other."""
    for goal in goals:
        path = np.stack([start, goal])
        points = motion_points(path, levers, resolution)
        inside = np.all((points >= lower) & (points <= upper), axis=1)
        if np.all(inside & is_free(points)):
            return path
    return None
