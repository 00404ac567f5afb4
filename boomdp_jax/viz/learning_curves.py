"""Curves of runs over steps and of learners over samples, with bands."""

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from boomdp_jax.viz.style import (
    BASELINE,
    EDGE,
    FLOOR,
    GRID,
    PIN,
    PREDICTION,
    ROD,
    SLIDE,
    STATIC,
)

Band = tuple[
    Float[np.ndarray, " step"], Float[np.ndarray, " step"], Float[np.ndarray, " step"]
]
"""Middle, lower and upper end."""

_MOST_IN_A_ROW = 4
_LEAST_ERROR = 1e-6
"""Of a prediction that is worth drawing [m]."""
_LONG = 100
"""Steps from which on their axis is logarithmic, so that the first ones are seen."""
_BY_AGENT = {
    "true": EDGE,
    "true-way": EDGE,
    "physics": PREDICTION,
    "physics-way": PREDICTION,
    "physics-pretrained": SLIDE,
    "physics-kinds": FLOOR,
    "physics-map": FLOOR,
    "physics-informative": SLIDE,
    "physics-residual": ROD,
    "papers": ROD,
    "point-fit": FLOOR,
    "cma-es": SLIDE,
    "lr": ROD,
    "lr-body": STATIC,
    "lwr": BASELINE,
    "lwr-world": BASELINE,
    "lwr-pretrained": PIN,
    "oo-lwr": PIN,
    "gp": FLOOR,
    "ensemble": PIN,
    "random": STATIC,
}
"""Those of one colour differ by their strokes where they are shown together."""
# More agents than colours that a colour-blind reader tells apart.
_COLOURS = (EDGE, PREDICTION, PIN, BASELINE, FLOOR, SLIDE, ROD, STATIC)
_STROKES = ("-", "--", ":", "-.", (0, (6.0, 1.5, 1.0, 1.5, 1.0, 1.5)))
_WIDEST_LABEL = 40
"""Letters of a line beside an axis."""
_LEGEND_LENGTH = 3.5
"""Of a stroke in the legend, in sizes of its letters: two would not show a pattern."""

Line = tuple[str, Any]
"""Colour and stroke."""


def lines_of(names: Iterable[str]) -> dict[str, Line]:
    """A line for each curve of a figure, no two alike.

    An agent has its own colour, whatever else is shown. Of several of one colour the
    first has a solid line and the others are broken.

    Args:
        names: of the curves, in order: an agent's, and whatever follows a space.

    Returns:
        Colour and stroke by name. Beyond forty curves they come again.
    """
    names = list(names)
    lines: dict[str, Line] = {}
    taken: set[Line] = set()
    for name in names:
        own = _BY_AGENT.get(name.partition(" ")[0], SLIDE)
        colours = (own, *(colour for colour in _COLOURS if colour != own))
        choices = [(colour, stroke) for colour in colours for stroke in _STROKES]
        lines[name] = next((line for line in choices if line not in taken), choices[0])
        taken.add(lines[name])
    return lines


def draw_curves(
    ax: Any,
    bands: Mapping[str, Band],
    *,
    ylabel: str,
    is_logarithmic: bool = False,
    sizes: Sequence[int] | None = None,
    lines: Mapping[str, Line] | None = None,
) -> None:
    """Draw a curve with its band for each agent.

    Args:
        ax: a `matplotlib.axes.Axes`.
        bands: by name, one value a step from step 1 on; NaN is left out.
        ylabel: what is drawn, with its unit.
        is_logarithmic: whether its axis is.
        sizes: numbers of samples that the values belong to, instead of steps.
        lines: colour and stroke by name, of a figure in which there are more curves
            than here; default: as `lines_of` has them for these.
    """
    lines = lines_of(bands) if lines is None else lines
    for name, (middle, low, high) in bands.items():
        colour, stroke = lines[name]
        steps = np.arange(1, len(middle) + 1) if sizes is None else np.asarray(sizes)
        ax.fill_between(steps, low, high, color=colour, alpha=0.2, linewidth=0)
        look = {"color": colour, "linestyle": stroke, "linewidth": 1.6}
        ax.plot(steps, middle, label=name, **look)
    if is_logarithmic:
        ax.set_yscale("log")
    if sizes is not None or any(len(band[0]) > _LONG for band in bands.values()):
        ax.set_xscale("log")
    ax.set_xlabel("step" if sizes is None else "samples")
    ax.set_ylabel(ylabel)
    if bands:
        # Without a curve the axis ends at 1, where it would begin.
        ax.set_xlim(left=1 if sizes is None else sizes[0])
    ax.grid(color=GRID, linewidth=0.8)
    ax.set_axisbelow(True)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)


def plot_curves(
    reward: Mapping[str, Band],
    model_error: Mapping[str, Band],
    *,
    title: str,
    band: str = "95 % band",
) -> Any:
    """A figure of reward and of model error by step.

    Args:
        reward: by agent.
        model_error: by agent [m].
        title: of the figure.
        band: what the bands are.

    Returns:
        The `matplotlib.figure.Figure`.

    Raises:
        ImportError: matplotlib is not installed.
    """
    from boomdp_jax.viz.snapshots import new_figure

    figure = new_figure((10.0, 4.6))
    left, right = figure.subplots(1, 2)
    # On the right some may be missing, and the others look as they do on the left.
    lines = lines_of([*reward, *(name for name in model_error if name not in reward)])
    label = textwrap.fill(f"mean reward of a step, {band}", _WIDEST_LABEL)
    draw_curves(left, reward, ylabel=label, lines=lines)
    positive: dict[str, Band] = {}
    for name, (middle, low, high) in model_error.items():
        # Who knows the world errs by rounding alone, which would stretch the axis.
        if np.nanmax(middle) > _LEAST_ERROR:
            middle, low, high = (
                np.maximum(part, _LEAST_ERROR) for part in (middle, low, high)
            )
            positive[name] = middle, low, high
    draw_curves(
        right,
        positive,
        ylabel="error of foretold positions, one step [m]",
        is_logarithmic=bool(positive),
        lines=lines,
    )
    _name_curves(figure, left)
    figure.suptitle(title)
    return figure


def plot_sample_curves(
    position: Mapping[str, Band],
    velocity: Mapping[str, Band],
    sizes: Sequence[int],
    *,
    title: str,
) -> Any:
    """A figure of held-out errors by number of samples.

    Args:
        position: by learner, one value a size [m].
        velocity: by learner [m/s].
        sizes: numbers of samples.
        title: of the figure.

    Returns:
        The `matplotlib.figure.Figure`.

    Raises:
        ImportError: matplotlib is not installed.
    """
    from boomdp_jax.viz.snapshots import new_figure

    figure = new_figure((10.0, 4.6))
    left, right = figure.subplots(1, 2)
    labels = "held-out error of position [m]", "held-out error of velocity [m/s]"
    lines = lines_of([*position, *(name for name in velocity if name not in position)])
    for ax, bands, label in zip(
        (left, right), (position, velocity), labels, strict=True
    ):
        draw_curves(
            ax, bands, ylabel=label, is_logarithmic=True, sizes=sizes, lines=lines
        )
    _name_curves(figure, left)
    figure.suptitle(title)
    return figure


def _name_curves(figure: Any, ax: Any) -> None:
    """In rows below: within the axes there may be no place that is free."""
    handles, labels = ax.get_legend_handles_labels()
    if handles:
        num_rows = -(-len(labels) // _MOST_IN_A_ROW)
        num_each = -(-len(labels) // num_rows)
        place = "outside lower center"
        look = {"frameon": False, "handlelength": _LEGEND_LENGTH}
        figure.legend(handles, labels, loc=place, ncols=num_each, **look)
