"""What a moving picture shows, checked and ready for any kind of file."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.viz.joint_marks import JointMarks, link_ends, to_world

_MARGIN = 0.06
"""Empty rim around all that moves, as a share of its extent."""


class Film(NamedTuple):
    """A trajectory with all that is drawn of it."""

    spec: SceneSpec
    times: Float[np.ndarray, " time"]
    """Since the first state, increasing [s]."""
    poses: Float[np.ndarray, "time body 3"]
    """Finite [m, m, rad]."""
    marks: JointMarks
    bounds: Float[np.ndarray, "2 2"]
    """Least and greatest x and y of all that is ever drawn [m]."""
    fps: float
    """Most frames per simulated second."""
    title: str
    has_trail: bool


def nearest_states(
    times: Float[np.ndarray, " time"], period: float
) -> Int[np.ndarray, " frame"]:
    """Which state is shown in each frame of a film with frames of equal length.

    Args:
        times: times of the states, increasing from zero [s].
        period: length of a frame [s].

    Returns:
        Indices of the states nearest in time; the last state is always among them.
    """
    # A little less than the whole, so that rounding adds no frame after the last.
    num_frames = int(np.ceil(times[-1] / period - 1e-6)) + 1
    wanted = period * np.arange(num_frames)
    after = np.clip(np.searchsorted(times, wanted), 1, max(len(times) - 1, 1))
    if len(times) == 1:
        return np.zeros(1, int)
    is_before_nearer = wanted - times[after - 1] <= times[after] - wanted
    return np.where(is_before_nearer, after - 1, after)


def film_bounds(
    spec: SceneSpec, poses: Float[np.ndarray, "time body 3"], marks: JointMarks
) -> Float[np.ndarray, "2 2"]:
    """Bounds of everything that is drawn at any time, with a rim.

    Args:
        spec: the scene.
        poses: poses over time [m, m, rad].
        marks: joints and wheels.

    Returns:
        Least and greatest x and y [m].
    """
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for index, body in enumerate(spec.bodies):
        corners = body.vertices if len(body.vertices) else np.zeros((1, 2))
        points = to_world(corners, poses[:, index]).reshape(-1, 2)
        low = np.minimum(low, points.min(axis=0) - body.radius)
        high = np.maximum(high, points.max(axis=0) + body.radius)
    for link in marks.links:
        ends = np.concatenate(link_ends(link, poses))
        low = np.minimum(low, ends.min(axis=0))
        high = np.maximum(high, ends.max(axis=0))
    rim = _MARGIN * np.max(high - low)
    return np.stack([low - rim, high + rim])
