"""Reasons for doubt about velocities, each body named for one thing."""

import numpy as np
from jaxtyping import Float

from boomdp_jax.core.history import History
from boomdp_jax.inference.doubts.derived_velocities import derived_velocity_reasons
from boomdp_jax.inference.doubts.pose_velocity_agreement import pose_velocity_reasons
from boomdp_jax.inference.readings.pose_steps import (
    POSITIONS,
    steps_of,
    weighted_median,
)
from boomdp_jax.physics.scene_spec import SceneSpec

# Of velocities along the body's own axes: so many sds more rows than half are nearer to
# them turned by its angle than as told. Of the way from the one to the other that rates
# are at, the median is one; where velocities are noise alone, one half.
_SDS, _LEAST_TURNED = 4.0, 0.75
# How far a body may go round in a row [rad].
_MOST_ROUND = 1.5


def velocity_reasons(spec: SceneSpec, history: History) -> list[str]:
    """All reasons for doubt about velocities beside poses, without any model.

    Velocities along the body's own axes were seen in 24 of 24 recordings of rods and
    wheels that were read exactly, in 23 and 21 with noise of 0.2 and 1 mm and 80 rows,
    in 19 and 8 with 20 rows; in none of 3,200 right ones.

    Args:
        spec: the scene, for names.
        history: its readings.

    Returns:
        Lines of `pose_velocity_reasons`; of other bodies, velocities along their own
        axes, and lines of `derived_velocity_reasons`.
    """
    named = pose_velocity_reasons(spec, history)
    for body in np.flatnonzero(~np.asarray(spec.is_static)):
        name = spec.names[body]
        is_named = any(line.startswith(f"{name}: ") for line in named)
        if not is_named and _is_along_own_axes(history, int(body)):
            named.append(
                f"{name}: velocities turned by its angle fit how positions change, and "
                "as told they do not, as if along the body's own axes; expected them "
                "along the world's"
            )
    return [*named, *derived_velocity_reasons(spec, history, named)]


def _is_along_own_axes(history: History, body: int) -> bool:
    """Whether rates are nearer to velocities that are turned by the body's angle."""
    steps = steps_of(history, body, *POSITIONS)
    is_read = (history.state_mask, history.next_state_mask)
    angle, last = (
        np.where(mask, values, np.nan)[steps.index, body, 2]
        for mask, values in zip(
            is_read, (history.state, history.next_state), strict=True
        )
    )
    turned = 0.5 * (_turned(steps.first, angle) + _turned(steps.last, last))
    apart = turned - steps.mean
    size = np.sum(apart**2, axis=1)
    # Of a body that goes far round in a row neither mean says anything.
    spin = np.where(history.state_mask, history.state, np.nan)[steps.index, body, 5]
    round_ = np.fmax(np.abs(last - angle), np.abs(spin) * steps.dt)
    use = (size > 0.0) & ~(round_ > _MOST_ROUND)
    num = int(np.sum(use))
    if num == 0:
        return False
    along = np.sum((steps.rate - steps.mean) * apart, axis=1)[use] / size[use]
    counted = (2.0 * np.sum(along > 0.5) - num) / np.sqrt(num)
    return bool(counted > _SDS and weighted_median(along, size[use]) > _LEAST_TURNED)


def _turned(
    twist: Float[np.ndarray, "row 2"], angle: Float[np.ndarray, " row"]
) -> Float[np.ndarray, "row 2"]:
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = twist.T
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=1)
