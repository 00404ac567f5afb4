"""A scene as seen from above: outlines in the world frame, with names."""

from typing import Any

import numpy as np

from boomdp_jax.physics import State
from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.viz.style import BODY, EDGE, STATIC


def draw_scene(
    ax: Any,
    spec: SceneSpec,
    state: State | None = None,
    *,
    has_names: bool = True,
    alpha: float = 1.0,
) -> None:
    """Draw every body's outline where it is.

    Args:
        ax: a `matplotlib.axes.Axes`.
        spec: the scene.
        state: where the bodies are; default: where the scene file puts them.
        has_names: whether to write each body's name on it.
        alpha: opacity in [0, 1], to draw several states on one another.
    """
    from matplotlib.patches import Circle, Polygon

    poses = np.asarray(spec.initial_state().pose if state is None else state.pose)
    for body, pose in zip(spec.bodies, poses, strict=True):
        style = {
            "facecolor": STATIC if body.is_static else BODY,
            "edgecolor": EDGE,
            "linewidth": 1.2,
            "alpha": alpha,
            "zorder": 1,
        }
        cosine, sine = np.cos(pose[2]), np.sin(pose[2])
        rotation = np.array([[cosine, -sine], [sine, cosine]])
        if body.kind == "circle":
            patch = Circle(pose[:2] - rotation @ body.shift, body.radius, **style)
            ax.add_patch(patch)
            ax.plot(*_spoke(pose, body.radius), color=EDGE, linewidth=1.0, alpha=alpha)
        else:
            corners = pose[:2] + body.vertices @ rotation.T
            ax.add_patch(Polygon(corners, closed=True, **style))
        if has_names:
            ax.annotate(body.name, pose[:2], ha="center", va="center", fontsize=8)
    ax.set_aspect("equal", adjustable="datalim")
    ax.autoscale_view()
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")


def _spoke(pose: np.ndarray, radius: float) -> tuple[list[float], list[float]]:
    """Ends of the line from a circle's centre that shows how it is turned."""
    x, y, theta = pose
    return [x, x + radius * np.cos(theta)], [y, y + radius * np.sin(theta)]
