"""Whether bodies start where their joints hold them; the first step moves them there.

A recording that begins with such a jump looks as if something had hit the bodies.
"""

import math
from collections.abc import Iterator, Sequence

import jax
import numpy as np
from jaxtyping import Float

from boomdp_jax.physics.constraint_spec import JOINTS
from boomdp_jax.physics.params import WORLD, Params
from boomdp_jax.physics.state import State

START_TOLERANCE = 1e-3
"""Largest gap that goes unsaid [m, rad]: what rounding in a file's numbers makes."""

_WORDS = {"revolute": "pin", "distance": "rod", "prismatic": "guide", "weld": "weld"}


def start_gaps(params: Params, state: State, names: Sequence[str]) -> list[str]:
    """Tell which joints a state violates.

    Args:
        params: one hypothesis.
        state: where the bodies start.
        names: of the bodies.

    Returns:
        A clause for each joint that is off by more than `START_TOLERANCE`, in the
        order of the joints.
    """
    pose = np.asarray(state.pose, float)
    clauses = []
    for kind in JOINTS:
        joints = getattr(params, kind)
        if joints is None:
            continue
        joints = jax.tree.map(np.asarray, joints)
        for slot in np.flatnonzero(joints.active).tolist():
            own, other = int(joints.body_a[slot]), int(joints.body_b[slot])
            partner = "the world" if other == WORLD else f"body {names[other]!r}"
            to_b = np.zeros(3) if other == WORLD else pose[other]
            for gap, unit in _gaps(kind, joints, slot, pose[own], to_b):
                if abs(gap) > START_TOLERANCE:
                    clauses.append(
                        f"body {names[own]!r} starts {abs(gap):.3g} {unit} off its "
                        f"{_WORDS[kind]} to {partner}"
                    )
    return clauses


def _gaps(
    kind: str, joints, slot: int, pose_a: np.ndarray, pose_b: np.ndarray
) -> Iterator[tuple[float, str]]:
    """By how much one joint fails to hold, as `physics.joints` defines it."""
    offset = _placed(pose_a, joints.anchor_a[slot])
    offset = offset - _placed(pose_b, joints.anchor_b[slot])
    if kind == "distance":
        yield float(np.hypot(*offset) - joints.length[slot]), "m"
    elif kind == "prismatic":
        angle = pose_b[2] + joints.axis[slot]
        yield float(math.cos(angle) * offset[1] - math.sin(angle) * offset[0]), "m"
    else:
        yield float(np.hypot(*offset)), "m"
    if kind in ("prismatic", "weld"):
        # Whole turns count: the step takes them back too.
        yield float(pose_a[2] - pose_b[2] - joints.angle[slot]), "rad"


def _placed(
    pose: Float[np.ndarray, "3"], anchor: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "2"]:
    """Where an anchor is in the world; that of the world has a pose of zeros."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    x, y = anchor
    return pose[:2] + np.array([cos * x - sin * y, sin * x + cos * y])
