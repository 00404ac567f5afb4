"""Joints that a scene knows, held against where readings have the bodies."""

import numpy as np
from jaxtyping import Float

from boomdp_jax.core.history import History
from boomdp_jax.inference.readings.reading_sequence import (
    readings_in_order,
    rounding_step,
    scatter,
)
from boomdp_jax.physics.constraint_spec import JOINTS, ConstraintSpec
from boomdp_jax.physics.joint_gaps import JOINT_WORDS, joint_gaps
from boomdp_jax.physics.params import WORLD
from boomdp_jax.physics.scene_spec import SceneSpec

# Gaps in most readings that are so many times as large as their noise, and larger than
# play and calibration make them, are no noise.
_TIMES, _LEAST = 4.0, {"m": 5e-3, "rad": 2e-2}


def known_joint_reasons(spec: SceneSpec, history: History) -> list[str]:
    """Reasons for doubt about known joints that readings are off.

    Args:
        spec: the scene.
        history: its readings.

    Returns:
        One line for each known joint that does not hold, by the median over readings.
    """
    readings = readings_in_order(spec, history)
    reasons = []
    for joint in spec.constraints:
        if joint.kind not in JOINTS:
            continue
        for gap, unit in _gaps(joint, readings.values):
            is_read = np.all(np.isfinite(gap), axis=1)
            noise = scatter(gap, readings.run)
            if not np.any(is_read) or noise is None:
                continue
            noise = max(noise, _rounding(joint, readings.values, unit))
            size = float(np.median(np.linalg.norm(gap[is_read], axis=1)))
            if size > max(_TIMES * noise, _LEAST[unit]):
                other = joint.body_b
                partner = "the world" if other == WORLD else f"{spec.names[other]!r}"
                reasons.append(
                    f"{spec.names[joint.body_a]}: its readings are {size:.2g} {unit} "
                    f"off its known {JOINT_WORDS[joint.kind]} to {partner}, with noise "
                    f"of {noise:.2g} {unit} at most; expected anchors, angles and "
                    "lengths as the recording has them"
                )
    return reasons


def _gaps(
    joint: ConstraintSpec, values: Float[np.ndarray, "reading body 6"]
) -> list[tuple[Float[np.ndarray, "reading part"], str]]:
    """By how much a joint fails to hold at each reading, and units.

    NaN where the bodies were not read, or a number of the joint is to be inferred.
    """
    pose_a = values[:, joint.body_a, :3]
    is_world = joint.body_b == WORLD
    pose_b = np.zeros_like(pose_a) if is_world else values[:, joint.body_b, :3]
    return [
        (np.angle(np.exp(1j * gap)) if unit == "rad" else gap, unit)
        for gap, unit in joint_gaps(joint.kind, joint.numbers, pose_a, pose_b)
    ]


def _rounding(
    joint: ConstraintSpec, values: Float[np.ndarray, "reading body 6"], unit: str
) -> float:
    """How far rounded readings move what a joint holds [m] or [rad]."""
    steps = []
    for body, anchor in (
        (joint.body_a, joint.numbers["anchor_a"]),
        (joint.body_b, joint.numbers["anchor_b"]),
    ):
        if body == WORLD:
            continue
        turn = rounding_step(values[:, body, 2])
        place = max(rounding_step(values[:, body, part]) for part in (0, 1))
        lever = float(np.hypot(*np.nan_to_num(np.asarray(anchor, float))))
        steps.append(turn if unit == "rad" else np.hypot(place, turn * lever))
    return float(np.sqrt(np.sum(np.square(steps))))
