"""Predicted bands against motion that the posterior has not seen."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.arrays import Key
from boomdp_jax.core.history import History
from boomdp_jax.core.quick_compile import KeptJit
from boomdp_jax.inference.hypotheses.whole_motion import whole_scene
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.inference.posteriors.predict import commands_in_effect, sample_readings
from boomdp_jax.inference.posteriors.prediction_starts import (
    PredictionStarts,
    with_walls,
)
from boomdp_jax.viz.style import BASELINE, PREDICTION, READING

_sample = KeptJit(sample_readings, static=("freedom", "is_true"))

_LABELS = {
    "x": "x [m]",
    "y": "y [m]",
    "theta": "angle [rad]",
    "xdot": "velocity along x [m/s]",
    "ydot": "velocity along y [m/s]",
    "thetadot": "spin [rad/s]",
}
_COLUMNS = list(_LABELS)


def draw_prediction(
    ax: Any,
    posterior: Posterior,
    history: History,
    *,
    body: int | None = None,
    quantity: str | None = None,
    start: int | None = None,
    num_steps: int = 50,
    num_draws: int = 128,
    key: Key | None = None,
) -> None:
    """Draw the 90 % band of one predicted quantity with the readings over it.

    Args:
        ax: a `matplotlib.axes.Axes`.
        posterior: what is believed.
        history: held-out readings and wrenches.
        body: index of the body; default: the one that moves most.
        quantity: x, y, theta, xdot, ydot or thetadot; default: of the first three the
            one that moves most.
        start: row to predict from; default: the one followed by the most motion.
        num_steps: steps to predict; fewer where no episode is as long.
        num_draws: draws of the posterior.
        key: random key; default: that of seed 0.

    Raises:
        ValueError: no row has a complete reading to start from, or two of each pose
            before it, too few rows follow the start, or there is no such quantity.
    """
    spec = posterior.spec
    history = with_walls(spec, history)
    is_static = np.array([entry.is_static for entry in spec.bodies])
    key = jax.random.key(0) if key is None else key
    kept = posterior.thin(num_draws)
    known = PredictionStarts("auto", key, kept, history)
    starts, num_steps = _starts(known, num_steps, history.capacity)
    if start is None:
        start = _liveliest(history, starts, num_steps, is_static)
    rows = np.arange(start, start + num_steps)
    if start < 0 or rows[-1] >= history.capacity:
        raise ValueError(
            f"start: expected {num_steps} rows after it, got row {start} of "
            f"{history.capacity}"
        )
    reading, following = known.baseline(0)[start], np.asarray(history.next_state)[rows]
    body, quantity = _choose(reading, following, is_static, body, quantity)
    if quantity not in _LABELS:
        raise ValueError(f"quantity: expected one of {_COLUMNS}, got {quantity!r}")
    column = _COLUMNS.index(quantity)
    count = kept.num_draws
    begin = history.state[start][None] if known.state is None else known.state[:, start]
    commands = commands_in_effect(kept.params, history)
    action = history.action[None] if commands is None else commands
    draws = _sample(
        key,
        whole_scene(spec),
        spec.with_surface(kept.params),
        kept.noise_scale,
        jnp.broadcast_to(begin, (count, *begin.shape[1:])),
        jnp.broadcast_to(action, (count, *action.shape[1:]))[:, rows],
        jnp.broadcast_to(history.dt[rows], (count, num_steps)),
        jnp.arange(num_steps),
        kept.impulse_scale,
        freedom=posterior.degrees_of_freedom,
        is_true=known.state is not None,
    )
    time = np.concatenate([[0.0], np.cumsum(np.asarray(history.dt)[rows])])
    first = float(reading[body, column])
    values = np.asarray(draws[:, :, body, column])
    low, middle, high = np.quantile(values, (0.05, 0.5, 0.95), axis=0)
    rate = float(reading[body, column + 3]) if column < 3 else 0.0
    ax.fill_between(
        time[1:],
        low,
        high,
        color=PREDICTION,
        alpha=0.25,
        linewidth=0,
        label="predicted, 90 %",
    )
    ax.plot(
        time[1:], middle, color=PREDICTION, linewidth=1.5, label="predicted, median"
    )
    ax.plot(
        time,
        first + rate * time,
        color=BASELINE,
        linestyle="--",
        linewidth=1.2,
        label="constant velocity",
    )
    is_read = np.asarray(history.next_state_mask)[rows, body, column]
    seen, at = following[is_read, body, column], time[1:][is_read]
    if history.state_mask[start, body, column]:
        seen, at = np.append(first, seen), np.append(0.0, at)
    ax.plot(
        at,
        seen,
        linestyle="",
        marker="o",
        markersize=2.8,
        color=READING,
        label="held-out readings",
    )
    _fit_to(ax, np.concatenate([low, high, seen]))
    ax.set_xlabel("time ahead [s]")
    name = spec.bodies[body].name
    ax.set_ylabel(f"{name}: {_LABELS[quantity]}")
    ax.legend(fontsize=8, frameon=False)
    ax.spines[["top", "right"]].set_visible(False)


def _starts(
    known: PredictionStarts, num_steps: int, num_rows: int
) -> tuple[np.ndarray, int]:
    """Rows to start from, with as many steps as an episode allows."""
    for length in range(min(num_steps, num_rows), 0, -1):
        starts = known.rows(length)
        if len(starts):
            return starts, length
    raise ValueError(
        "history: expected a row with a complete reading, or one until which every "
        "pose was read twice, got none"
    )


def _liveliest(
    history: History, starts: np.ndarray, num_steps: int, is_static: np.ndarray
) -> int:
    """The start that is followed by the widest motion."""
    pose = np.asarray(history.next_state)[:, ~is_static, :3]
    spans = [
        np.ptp(pose[start : start + num_steps], axis=0).max(initial=0.0)
        for start in starts
    ]
    return int(starts[int(np.argmax(spans))])


def _choose(
    reading: np.ndarray,
    following: np.ndarray,
    is_static: np.ndarray,
    body: int | None,
    quantity: str | None,
) -> tuple[int, str]:
    """The body and the number that move most, where they are not given."""
    span = np.ptp(np.concatenate([reading[None], following]), axis=0)[:, :3]
    span = np.where(is_static[:, None], -1.0, span)
    if body is None:
        body = int(np.argmax(span.max(axis=1)))
    if quantity is None:
        quantity = _COLUMNS[int(np.argmax(span[body]))]
    return body, quantity


def _fit_to(ax: Any, values: np.ndarray) -> None:
    """Fit the axis to predictions and readings, not to a baseline that runs away."""
    values = values[np.isfinite(values)]
    margin = 0.08 * max(float(np.ptp(values)), 1e-6)
    ax.set_ylim(values.min() - margin, values.max() + margin)
