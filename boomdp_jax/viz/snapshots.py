"""One instant of a scene: outlines, and the pins, rods and wheels that hold them."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.physics.state import State
from boomdp_jax.viz.joint_marks import JointMarks, draw_joint_marks, joint_marks
from boomdp_jax.viz.scenes import draw_scene


def draw(
    spec: SceneSpec,
    state: State | None = None,
    *,
    params: Params | None = None,
    ax: Any = None,
) -> Any:
    """Draw a scene with what holds its bodies.

    Pins are rings, on an arm from the centre of mass; rods are lines between rings;
    wheels are tyres along their heading.

    Args:
        spec: the scene.
        state: where the bodies are; default: where the scene file puts them.
        params: one hypothesis, whose active joints and wheels are drawn; default: those
            that the scene file gives.
        ax: a `matplotlib.axes.Axes`; default: that of a new figure.

    Returns:
        The axes; `.figure` is the figure, free of any global state if it is new.

    Raises:
        ValueError: poses of other bodies, or ones that are not finite.
        ImportError: matplotlib is not installed.
    """
    marks = joint_marks(spec, params)
    start = spec.initial_state() if state is None else state
    poses = check_poses(spec, np.asarray(start.pose, float)[None])[0]
    if ax is None:
        ax = new_figure((6.4, 4.8)).add_subplot()
    draw_instant(ax, spec, poses, marks)
    ax.autoscale_view()
    return ax


def draw_instant(
    ax: Any, spec: SceneSpec, poses: Float[np.ndarray, "body 3"], marks: JointMarks
) -> None:
    """Draw outlines, then marks, then names on top of both.

    Args:
        ax: a `matplotlib.axes.Axes`.
        spec: the scene.
        poses: where the bodies are [m, m, rad].
        marks: joints and wheels.
    """
    from matplotlib.patheffects import withStroke

    pose = jnp.asarray(poses, float)
    state = State(pose=pose, twist=jnp.zeros_like(pose))
    draw_scene(ax, spec, state, has_names=False)
    draw_joint_marks(ax, spec, poses, marks)
    rim = [withStroke(linewidth=2.5, foreground="white", alpha=0.8)]
    for name, place in zip(spec.names, poses[:, :2], strict=True):
        text = ax.annotate(name, place, ha="center", va="center", fontsize=8, zorder=6)
        text.set_path_effects(rim)


def check_poses(spec: SceneSpec, poses: np.ndarray) -> np.ndarray:
    """Make sure that every body has a place at every instant.

    Args:
        spec: the scene.
        poses: poses over time [m, m, rad].

    Returns:
        The same poses.

    Raises:
        ValueError: which frame and body is wrong, what was expected, what was got.
    """
    if poses.ndim != 3 or poses.shape[1:] != (spec.num_bodies, 3) or not len(poses):
        raise ValueError(
            f"poses: expected one or more frames of {spec.num_bodies} bodies, shape "
            f"[time, {spec.num_bodies}, 3], got {list(poses.shape)}"
        )
    is_lost = ~np.all(np.isfinite(poses), axis=-1)
    if np.any(is_lost):
        frame, body = np.argwhere(is_lost)[0]
        raise ValueError(
            f"poses: expected finite numbers, got {poses[frame, body].tolist()} in "
            f"frame {frame}, body {spec.names[body]!r}"
        )
    return poses


def new_figure(size: tuple[float, float]) -> Any:
    """An empty figure that no display and no global list of figures knows.

    Args:
        size: width and height [inch].

    Returns:
        A `matplotlib.figure.Figure`.

    Raises:
        ImportError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError(
            "matplotlib is not installed; pip install 'boomdp_jax[plot]'"
        ) from error
    return Figure(figsize=size, layout="constrained")
