"""Whether bodies start where their joints let them be; the first step moves them there.

A recording that begins with such a jump looks as if something had hit the bodies.
"""

from collections.abc import Sequence

import jax
import numpy as np

from boomdp_jax.physics.constraint_spec import JOINTS
from boomdp_jax.physics.joint_gaps import JOINT_WORDS, joint_gaps, joint_travel
from boomdp_jax.physics.params import WORLD, Params
from boomdp_jax.physics.state import State

START_TOLERANCE = 1e-3
"""Largest gap that goes unsaid [m, rad]: what rounding in a file's numbers makes."""


def start_gaps(params: Params, state: State, names: Sequence[str]) -> list[str]:
    """Tell which joints a state violates.

    Args:
        params: one hypothesis.
        state: where the bodies start.
        names: of the bodies.

    Returns:
        A clause for each joint that is off, or outside its range, by more than
        `START_TOLERANCE`, in the order of the joints.
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
            numbers = {
                name: getattr(joints, name)[slot]
                for name in ("anchor_a", "anchor_b", "length", "axis", "angle")
                if hasattr(joints, name)
            }
            # Whole turns count: the step takes them back too.
            for gap, unit in joint_gaps(kind, numbers, pose[own][None], to_b[None]):
                size = float(np.linalg.norm(gap))
                if size > START_TOLERANCE:
                    clauses.append(
                        f"body {names[own]!r} starts {size:.3g} {unit} off its "
                        f"{JOINT_WORDS[kind]} to {partner}"
                    )
            limit = getattr(joints, "limit", None)
            if limit is None:
                continue
            travel, unit = joint_travel(kind, numbers, pose[own][None], to_b[None])
            lower, upper = limit[slot]
            size = float(max(lower - travel[0], travel[0] - upper))
            if size > START_TOLERANCE:
                clauses.append(
                    f"body {names[own]!r} starts {size:.3g} {unit} outside the range "
                    f"of its {JOINT_WORDS[kind]} to {partner}"
                )
    return clauses
