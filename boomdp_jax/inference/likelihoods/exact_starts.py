r"""Predictions that start from readings taken as exact: single steps and open loops.

A prediction starts at a reading and goes on, uncorrected, for up to k steps; then the
next one starts. With $F^j$ the step applied j times,

$$y_{t+j} = F_\Phi^j(y_t, a_t, \dots, a_{t+j-1}) + \epsilon_{t+j}, \qquad j \le k,$$

errors independent, their scale integrated out (`one_step.log_marginal`). k = 1 is
equation 1 of "What Does Physics Bias". As a filter with fixed gains (`tracking`): gain
one where a prediction starts, gain nought from there on.

The errors are independent if starts are exact and, with k above 1, the motion is. Noise
of a start or of the motion goes on into every later step of the prediction; with one
step to each prediction only that of the start does.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from boomdp_jax.core.arrays import on_device
from boomdp_jax.inference.likelihoods.kalman import channel_scale
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.likelihoods.tracking import Gains
from boomdp_jax.inference.readings.track_data import TrackData


class ExactStarts(NamedTuple):
    """Where predictions start."""

    horizon: int | None
    """Most steps of one; None: it goes from the first reading of a run to its last."""


def open_loop_gains(data: TrackData, scale: np.ndarray, starts: ExactStarts) -> Gains:
    """Gains that believe the reading a prediction starts from, and no other.

    Args:
        data: the readings.
        scale: by which innovations are divided, `[body, 6]`.
        starts: where predictions start.

    Returns:
        Gains under which tracking is open-loop prediction. A second reading of an
        instant counts where no prediction starts from it.
    """
    begins, counts = _predictions(data, starts)
    num_rows, num = len(begins), data.steps.state.shape[1] * 6
    weight = 1.0 / np.asarray(scale).reshape(-1)[None]
    last = np.asarray(data.last_mask).reshape(num_rows, num)
    second = np.asarray(data.is_second).reshape(num_rows, num)
    is_between = counts & ~begins
    # Where a track starts its state is that reading already.
    jumps = begins & ~(np.asarray(data.is_start) > 0)
    identity = np.broadcast_to(np.eye(num), (num_rows, num, num))
    parts = (
        jumps[:, None, None] * identity,
        0.0 * identity,
        identity * (is_between[:, None] * second * weight)[:, None, :],
        identity * (counts[:, None] * last * weight)[:, None, :],
    )
    dtype = data.steps.state.dtype
    return Gains(*(on_device(part, dtype) for part in parts))


def covered_rows(data: TrackData, starts: ExactStarts) -> Bool[np.ndarray, " time"]:
    """Rows that some prediction leads through."""
    return _predictions(data, starts)[1]


def _predictions(data: TrackData, starts: ExactStarts) -> tuple[np.ndarray, np.ndarray]:
    """Rows where a prediction starts, and rows that one leads through.

    One starts where the one before has taken all its steps, or there is none, and what
    the row starts from was read in full.
    """
    is_whole = np.all(np.asarray(data.first_mask) > 0, axis=(1, 2))
    is_start = np.asarray(data.is_start) > 0
    begins, counts = np.zeros(len(is_whole), bool), np.zeros(len(is_whole), bool)
    horizon = len(is_whole) if starts.horizon is None else starts.horizon
    steps_left = 0
    for row in range(len(is_whole)):
        if is_start[row]:
            steps_left = 0
        if steps_left == 0 and is_whole[row]:
            begins[row], steps_left = True, horizon
        counts[row] = steps_left > 0
        steps_left = max(steps_left - 1, 0)
    return begins, counts


def with_open_loop(targets: StructureTarget, starts: ExactStarts) -> StructureTarget:
    """Give all structures the gains of open-loop prediction.

    Args:
        targets: with the one-step gains that `make_block` sets, stacked along a leading
            object axis.
        starts: where predictions start.

    Returns:
        Targets whose likelihood predicts so; the same where predictions have one step.
    """
    if starts.horizon == 1:
        return targets
    likelihood: Any = targets.log_likelihood
    num_objects, num_structures = targets.structures.shape[:2]
    data = jax.tree.map(np.asarray, likelihood.data)
    reference = np.asarray(likelihood.reference)
    each = [
        open_loop_gains(
            jax.tree.map(lambda leaf, i=index: leaf[i], data),
            channel_scale(reference[index, 0]),
            starts,
        )
        for index in range(num_objects)
    ]

    def arrange(*leaves):
        stacked = np.stack([np.asarray(leaf) for leaf in leaves])[:, None]
        shape = (num_objects, num_structures, *stacked.shape[2:])
        return on_device(np.broadcast_to(stacked, shape), stacked.dtype)

    if likelihood.data.may_touch is not None:
        # Predictions may lead to where nothing was.
        targets = eqx.tree_at(
            lambda t: t.log_likelihood.data.may_touch,
            targets,
            jnp.ones_like(likelihood.data.may_touch),
        )
    return eqx.tree_at(
        lambda t: t.log_likelihood.gains, targets, jax.tree.map(arrange, *each)
    )
