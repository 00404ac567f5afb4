"""A trajectory as a moving picture: a GIF, or a page with a player in it."""

import os
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float

from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.physics.state import State
from boomdp_jax.viz.film import Film, film_bounds
from boomdp_jax.viz.gif import write_gif
from boomdp_jax.viz.joint_marks import joint_marks
from boomdp_jax.viz.player import write_player
from boomdp_jax.viz.snapshots import check_poses

_WRITERS: dict[str, Callable[[str | os.PathLike, Film], None]] = {
    ".gif": write_gif,
    ".html": write_player,
}
ANIMATION_SUFFIXES = tuple(_WRITERS)
"""Kinds of files that `animate` writes."""


def animate(
    spec: SceneSpec,
    states: State,
    path: str | os.PathLike,
    *,
    dt: float | int | np.ndarray | jax.Array | None = None,
    params: Params | None = None,
    fps: float | int = 30,
    title: str | None = None,
    has_trail: bool = False,
) -> None:
    """Write a trajectory as a moving picture that plays in real time.

    A `.gif` needs matplotlib and shows on any page; it costs about a tenth of a
    second a frame. A `.html` needs nothing, opens in any browser without a network,
    and can be stopped, scrubbed, slowed down and zoomed.

    Args:
        spec: the scene.
        states: trajectory, with a leading time axis; the first is shown at time zero.
        path: file to write, whole or not at all; its ending says the kind.
        dt: time between states [s], one for all or one for each two that follow one
            another; default: the scene's.
        params: one hypothesis, whose active joints and wheels are drawn; default: those
            that the scene file gives.
        fps: most frames for each second of simulated time; what is in between is left
            out. A GIF counts time in hundredths of a second and may show fewer.
        title: what it says on top; default: the name of the scene's file.
        has_trail: whether the paths of the centres of mass are drawn; in a player only
            how it starts.

    Raises:
        ValueError: another ending, poses that are not finite or of other bodies, times
            that do not increase, or more frames than a GIF can hold.
        ImportError: matplotlib is not installed, for a GIF.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _WRITERS:
        raise ValueError(
            f"{os.fspath(path)}: expected a file that ends in "
            f"{' or '.join(ANIMATION_SUFFIXES)}, got {suffix!r}"
        )
    if not 0 < fps < np.inf:
        raise ValueError(f"fps: expected a finite number above 0, got {fps}")
    poses = check_poses(spec, np.asarray(states.pose, float))
    marks = joint_marks(spec, params)
    film = Film(
        spec=spec,
        times=_times(spec, len(poses), dt),
        poses=poses,
        marks=marks,
        bounds=film_bounds(spec, poses, marks),
        fps=float(fps),
        title=Path(spec.source).name if title is None else title,
        has_trail=has_trail,
    )
    _WRITERS[suffix](path, film)


def _times(
    spec: SceneSpec, num_states: int, dt: float | int | np.ndarray | jax.Array | None
) -> Float[np.ndarray, " time"]:
    """Time of every state [s]."""
    lengths = np.asarray(spec.dt if dt is None else dt, float)
    if lengths.shape not in ((), (num_states - 1,)):
        raise ValueError(
            f"dt: expected one number or {num_states - 1}, one between each two of "
            f"{num_states} states, got shape {lengths.shape}"
        )
    if not np.all((lengths > 0) & np.isfinite(lengths)):
        raise ValueError(f"dt: expected finite numbers above 0, got {lengths.min()}")
    lengths = np.broadcast_to(lengths, (num_states - 1,))
    return np.concatenate([[0.0], np.cumsum(lengths)])
