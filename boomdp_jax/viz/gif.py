"""A film as a GIF, drawn by matplotlib."""

import math
import os
import tempfile
from pathlib import Path

import numpy as np

from boomdp_jax.core.atomic import atomic_write
from boomdp_jax.viz.film import Film, nearest_states
from boomdp_jax.viz.snapshots import draw_instant, new_figure
from boomdp_jax.viz.style import GRID, PREDICTION

_MOST_FRAMES = 1500
"""A frame takes about a megabyte until the file is written."""
_TICK = 0.01
"""A GIF counts time in these [s]."""
_FASTEST = 2
"""Least ticks a frame; browsers slow faster ones down to a tenth of a second."""
_AREA = 30.0
"""Of the picture [inch²]; at 100 dots an inch."""
_ASPECT = (0.6, 2.0)
"""Least and greatest height over width."""


def write_gif(path: str | os.PathLike, film: Film) -> None:
    """Draw every frame and write them all as one GIF that plays over and over.

    Args:
        path: file to write.
        film: what to show.

    Raises:
        ValueError: more frames than fit into memory.
        ImportError: matplotlib is not installed.
    """
    ticks = frame_ticks(film)
    shown = nearest_states(film.times, ticks * _TICK)
    if len(shown) > _MOST_FRAMES:
        raise ValueError(
            f"{os.fspath(path)}: expected at most {_MOST_FRAMES} frames, got "
            f"{len(shown)}; give less fps, fewer states, or a path that ends in .html"
        )
    width, height = film.bounds[1] - film.bounds[0]
    aspect = float(np.clip(height / width, *_ASPECT))
    side = math.sqrt(_AREA / aspect)
    figure = new_figure((side, side * aspect))
    from matplotlib.animation import PillowWriter

    ax = figure.add_subplot()
    # The writer turns this back into whole milliseconds, rounding down.
    rate = 1000.0 / (1000.0 * _TICK * ticks + 0.5)
    writer = PillowWriter(fps=rate)  # ty: ignore[invalid-argument-type]
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "film.gif"
        with writer.saving(figure, str(whole), dpi=100):
            for index in shown:
                _draw_frame(ax, film, int(index))
                writer.grab_frame()
                # Laid out once: axes that move a little from frame to frame tremble.
                figure.set_layout_engine("none")
        atomic_write(path, whole.read_bytes())


def frame_ticks(film: Film) -> int:
    """Hundredths of a second for which each frame is shown.

    Args:
        film: what to show.

    Returns:
        As few as the film's frames per second allow, but no fewer than there are from
        one state to the next.
    """
    least = math.ceil(1.0 / (film.fps * _TICK) - 1e-6)
    gap = np.min(np.diff(film.times), initial=film.times[-1])
    return max(least, math.floor(gap / _TICK + 1e-6), _FASTEST)


def _draw_frame(ax, film: Film, index: int) -> None:
    """Replace what is on the axes by one state."""
    for artist in (*ax.patches, *ax.lines, *ax.texts):
        artist.remove()
    draw_instant(ax, film.spec, film.poses[index], film.marks)
    if film.has_trail:
        for body in np.flatnonzero(~film.spec.is_static):
            path = film.poses[: index + 1, body, :2]
            ax.plot(*path.T, color=PREDICTION, alpha=0.6, linewidth=1.2, zorder=2)
    ax.set_axisbelow(True)
    ax.grid(visible=True, color=GRID, linewidth=0.6)
    ax.set_aspect("equal", adjustable="box")
    ax.set_xlim(*film.bounds[:, 0])
    ax.set_ylim(*film.bounds[:, 1])
    ax.set_title(film.title, loc="left", fontsize=10)
    ax.set_title(f"{film.times[index]:.2f} s", loc="right", fontsize=10)
