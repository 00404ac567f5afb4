"""By how much joints fail to hold bodies at given poses, as `physics.joints` has it."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

JOINT_WORDS = {
    "revolute": "pin",
    "distance": "rod",
    "prismatic": "guide",
    "weld": "weld",
}
"""What people call each kind."""


def joint_gaps(
    kind: str,
    numbers: Mapping[str, np.ndarray],
    pose_a: Float[np.ndarray, "pose 3"],
    pose_b: Float[np.ndarray, "pose 3"],
) -> list[tuple[Float[np.ndarray, "pose part"], str]]:
    """Gaps of one joint at many poses, NaN where a pose or a number is.

    Args:
        kind: of the joint.
        numbers: by the names of the kind's class in `physics.params`.
        pose_a: of its first body.
        pose_b: of its second; that of the world is zeros.

    Returns:
        Of what has to come together [m], along the parts of it that a joint holds, and
        of what has to turn together [rad], where it holds that; with units. Whole turns
        count.
    """
    offset = _placed(pose_a, numbers["anchor_a"]) - _placed(pose_b, numbers["anchor_b"])
    if kind == "distance":
        length = np.hypot(offset[:, 0], offset[:, 1]) - float(numbers["length"])
        gaps = [(length[:, None], "m")]
    elif kind == "prismatic":
        angle = pose_b[:, 2] + float(numbers["axis"])
        across = np.cos(angle) * offset[:, 1] - np.sin(angle) * offset[:, 0]
        gaps = [(across[:, None], "m")]
    else:
        gaps = [(offset, "m")]
    if kind in ("prismatic", "weld"):
        turned = pose_a[:, 2] - pose_b[:, 2] - float(numbers["angle"])
        gaps.append((turned[:, None], "rad"))
    return gaps


def joint_travel(
    kind: str,
    numbers: Mapping[str, np.ndarray],
    pose_a: Float[np.ndarray, "pose 3"],
    pose_b: Float[np.ndarray, "pose 3"],
) -> tuple[Float[np.ndarray, " pose"], str]:
    """Where a pin or a drawer is, at many poses, in what its range is given in.

    Args:
        kind: revolute or prismatic.
        numbers: by the names of the kind's class in `physics.params`.
        pose_a: of its first body.
        pose_b: of its second; that of the world is zeros.

    Returns:
        How far it has turned [rad], whole turns included, or slid [m]; and the unit.
    """
    if kind == "revolute":
        return pose_a[:, 2] - pose_b[:, 2], "rad"
    offset = _placed(pose_a, numbers["anchor_a"]) - _placed(pose_b, numbers["anchor_b"])
    angle = pose_b[:, 2] + float(numbers["axis"])
    return np.cos(angle) * offset[:, 0] + np.sin(angle) * offset[:, 1], "m"


def _placed(
    pose: Float[np.ndarray, "pose 3"], anchor: np.ndarray
) -> Float[np.ndarray, "pose 2"]:
    """Where an anchor is in the world."""
    cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    x, y = np.asarray(anchor, float)
    return pose[:, :2] + np.column_stack([cos * x - sin * y, sin * x + cos * y])
