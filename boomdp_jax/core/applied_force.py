r"""A force at a point as a wrench at a body's reference point.

With p the point, x the reference point and f the force, all in the world frame,

$$\tau = \tau_0 + (p - x) \times f.$$

Where the centre of mass is not the reference point, the engine takes the wrench on to
it (`Params.center_of_mass`): the point is measured, the centre of mass inferred, and
neither has to know of the other.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def wrench_at_reference(
    wrench: Float[Array, "*batch 3"] | Float[np.ndarray, "*batch 3"],
    point: Float[Array, "*batch 2"] | Float[np.ndarray, "*batch 2"],
    pose: Float[Array, "*batch 3"] | Float[np.ndarray, "*batch 3"],
    *,
    frame: str = "world",
) -> Any:
    r"""Turn a force at a point into a wrench at the reference point of a pose.

    An error of the point is one of the torque, $|f|$ times the error across the force:
    to inference it is noise of the motion, which it infers.

    Args:
        wrench: force at the point, and a free torque besides, world frame [N, N, N m].
        point: where the force acts, in the world [m], or about the reference point
            along the axes of the body; NaN twice: at the reference point.
        pose: of the body when the force acts [m, m, rad].
        frame: of the point: `world` or `body`.

    Returns:
        The wrench at the reference point, world frame; NumPy arrays give one, as do
        arrays of JAX. NaN where a number that matters is NaN.

    Raises:
        ValueError: another frame.
    """
    if frame not in ("world", "body"):
        raise ValueError(f"frame: expected world or body, got {frame!r}")
    is_traced = any(isinstance(each, jax.Array) for each in (wrench, point, pose))
    xp: Any = jnp if is_traced else np
    # Guarded beforehand, so that derivatives are finite as well.
    is_centred = xp.all(xp.isnan(point), axis=-1, keepdims=True)
    has_force = xp.any(wrench[..., :2] != 0, axis=-1, keepdims=True)
    is_needed = has_force & ~is_centred
    place = xp.where(is_needed, point, 0.0)
    if frame == "world":
        arm = place - xp.where(is_needed, pose[..., :2], 0.0)
    else:
        angle = xp.where(is_needed[..., 0], pose[..., 2], 0.0)
        cos, sin = xp.cos(angle), xp.sin(angle)
        arm = xp.stack(
            [
                cos * place[..., 0] - sin * place[..., 1],
                sin * place[..., 0] + cos * place[..., 1],
            ],
            axis=-1,
        )
    torque = arm[..., 0] * wrench[..., 1] - arm[..., 1] * wrench[..., 0]
    return xp.concatenate(
        [wrench[..., :2], (wrench[..., 2] + torque)[..., None]], axis=-1
    )
