"""One figure of a posterior: bodies, structure probabilities, held-out motion."""

import os
from typing import Any

from boomdp_jax.core.history import History
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.viz.posteriors import draw_posterior
from boomdp_jax.viz.predictions import draw_prediction
from boomdp_jax.viz.snapshots import new_figure
from boomdp_jax.viz.structures import draw_structure_bars

_MOST_BODIES = 4
"""Bodies with a panel of their own; more would be too small to read."""


def plot_posterior(
    posterior: Posterior,
    path: str | os.PathLike | None = None,
    *,
    history: History | None = None,
    truth: Any = None,
) -> Any:
    """Draw everything on one figure.

    Args:
        posterior: what is believed.
        path: picture file to write; its ending says the format (png, pdf, svg).
        history: held-out motion; None: no panel for it.
        truth: what holds, as in `draw_posterior`.

    Returns:
        The `matplotlib.figure.Figure`, free of any global state.

    Raises:
        ImportError: matplotlib is not installed.
    """
    moving = [
        index for index, body in enumerate(posterior.spec.bodies) if not body.is_static
    ][:_MOST_BODIES]
    num_right = 1 if history is None else 2
    num_left = max(1, len(moving))
    figure = new_figure((4.6 * num_left + 5.2, 2.7 * num_right + 1.4))
    grid = figure.add_gridspec(
        num_right, num_left + 1, width_ratios=[*[1.0] * num_left, 1.1]
    )
    for column, body in enumerate(moving):
        draw_posterior(
            figure.add_subplot(grid[:, column]), posterior, body=body, truth=truth
        )
    draw_structure_bars(figure.add_subplot(grid[0, -1]), posterior)
    if history is not None:
        draw_prediction(figure.add_subplot(grid[1, -1]), posterior, history)
    if path is not None:
        figure.savefig(path, dpi=150)
    return figure
