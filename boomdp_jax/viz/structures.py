"""Structure probabilities as bars."""

import textwrap
from typing import Any

import numpy as np

from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.viz.style import EDGE, WHEEL

_FEWEST_ROWS = 3


def draw_structure_bars(ax: Any, posterior: Posterior, *, num_bars: int = 6) -> None:
    """Draw one horizontal bar per structure, most probable on top.

    Args:
        ax: a `matplotlib.axes.Axes`.
        posterior: what is believed.
        num_bars: bars to draw at most; the rest, structures that no draw has among
            them, is one bar more, "all others".
    """
    entries = list(posterior.structure_probabilities().items())
    shown, rest = entries[:num_bars], entries[num_bars:]
    num_possible = 2 ** sum(int(np.sum(slots)) for slots in posterior.inferred.values())
    if rest or len(entries) < num_possible:
        shown.append(("all others", sum(value for _, value in rest)))
    places = range(len(shown))
    values = [value for _, value in shown]
    ax.barh(places, values, height=0.6, color=WHEEL, edgecolor=EDGE, linewidth=0.6)
    for place, value in zip(places, values, strict=True):
        text = f"{value:.3f}" if value >= 0.001 else "< 0.001"
        # A long bar holds its number, a short one has it beside.
        inside = value > 0.8
        ax.annotate(
            text,
            (value, place),
            xytext=(-5 if inside else 5, 0),
            textcoords="offset points",
            ha="right" if inside else "left",
            va="center",
            fontsize=9,
            color="white" if inside else EDGE,
        )
    ax.set_yticks(list(places), [textwrap.fill(name, 26) for name, _ in shown])
    # Bars keep a like thickness, however few there are.
    ax.set_ylim(max(len(shown), _FEWEST_ROWS) - 0.4, -0.6)
    ax.set_xlim(0.0, 1.0)
    ax.set_xlabel("probability of the structure")
    ax.spines[["top", "right"]].set_visible(False)
