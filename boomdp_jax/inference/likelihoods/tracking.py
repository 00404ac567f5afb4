r"""A filter with gains fixed beforehand: what a hypothesis says of noisy readings.

States are latent and every reading of them is noisy, the ones that a step starts from
included. With $\hat x$ the best guess of a state given the readings so far,

$$e_t = y_t - F_\Phi(\hat x_{t-1}, a_{t-1}), \qquad
  \hat x_t = F_\Phi(\hat x_{t-1}, a_{t-1}) + K_t e_t, \qquad u_t = W_t e_t.$$

Gains K and whitenings W (inverse Cholesky factors of the innovations' covariance) are
those of an extended Kalman filter at the best fit of the same structure
(`kalman.extended_filter`). Fixed, a hypothesis costs one step a row and a fit is
least squares. With K = 1 for the reading that a step starts from and K = 0 for the one
that it ends at, this is the one-step likelihood of "What Does Physics Bias".
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, IntScalar, on_device
from boomdp_jax.inference.hypotheses.contact_prediction import (
    ContactScene,
    contact_step,
    first_impact,
    predict_step,
)
from boomdp_jax.inference.readings.track_data import TrackData, TrackRow, with_delay
from boomdp_jax.inference.readings.used_rows import scan_used
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import state_from_array
from boomdp_jax.physics.step import next_motion, prepare_step

# Largest number of channels for which products with gains are written out; beyond it
# a library call costs less than the compilation of so many terms.
_MAX_WRITTEN_OUT = 6


class Gains(eqx.Module):
    """What a filter does with the two readings of each row, worked out beforehand.

    The last batch axis is time, in a table of all rows.

    Rows and columns are channels, body by body; those of channels that were not read
    are zero, and so is everything of a reading that does not count.
    """

    first: Float[Array, "*batch channel channel"]
    """Gain of the reading that a row starts from; zero where a track starts."""
    last: Float[Array, "*batch channel channel"]
    first_whitening: Float[Array, "*batch channel channel"]
    last_whitening: Float[Array, "*batch channel channel"]

    @property
    def counts(self) -> Float[Array, "*batch time 2 channel"]:
        """One for each innovation that counts."""
        both = jnp.stack([self.first_whitening, self.last_whitening], axis=-3)
        diagonal = jnp.diagonal(both, axis1=-2, axis2=-1)
        return (diagonal > 0).astype(both.dtype)

    @property
    def log_volumes(self) -> Float[Array, "*batch time"]:
        """Log-determinant of the whitenings of each row."""
        both = jnp.stack([self.first_whitening, self.last_whitening], axis=-3)
        diagonal = jnp.diagonal(both, axis1=-2, axis2=-1)
        logs = jnp.log(jnp.where(diagonal > 0, diagonal, 1.0))
        return jnp.sum(logs, axis=(-2, -1))

    @property
    def log_volume(self) -> Float[Array, "*batch"]:
        """Log-determinant of all whitenings."""
        return jnp.sum(self.log_volumes, axis=-1)


def one_step_gains(data: TrackData, scale: np.ndarray) -> Gains:
    """Gains that believe every first reading and learn nothing from the last.

    Args:
        data: the readings.
        scale: by which innovations are divided, `[body, 6]`.

    Returns:
        Gains under which tracking is one-step prediction.
    """
    num_rows = data.first_mask.shape[0]
    num = data.steps.state.shape[1] * 6
    goes_on = 1.0 - np.asarray(data.is_start)[:, None, None]
    identity = np.broadcast_to(np.eye(num), (num_rows, num, num))
    counts = np.asarray(data.steps.mask).reshape(num_rows, num)
    counts = counts / np.asarray(scale).reshape(-1)[None]
    parts = (goes_on * identity, 0.0 * identity, 0.0 * identity)
    parts = (*parts, identity * counts[:, None, :])
    return Gains(*(on_device(part) for part in parts))


def channel_difference(
    reading: Float[Array, "body 6"], state: Float[Array, "body 6"]
) -> Float[Array, "body 6"]:
    """Reading minus state, angles the shorter way round."""
    difference = reading - state
    return difference.at[:, 2].set(_least_angle(difference[:, 2]))


def channel_differences(reading: Float[Array, "1 6"], state: list) -> list:
    """The same channel by channel, of one body."""
    each = [reading[0, i] - x for i, x in enumerate(state)]
    each[2] = _least_angle(each[2])
    return each


def _least_angle(angle):
    """The same direction by less than half a turn [rad]."""
    turns = jax.lax.stop_gradient(jnp.round(angle / (2.0 * jnp.pi)))
    return angle - 2.0 * jnp.pi * turns


Predict = Callable[
    [
        Float[Array, "body 6"],
        Float[Array, "body 3"],
        FloatScalar | None,
        BoolScalar | None,
    ],
    Float[Array, "body 6"],
]
"""From channels, wrenches, a length (None: that of all steps), and whether anything may
touch (None: it may), to channels."""


def predictor(
    scene: Scene | ContactScene,
    params: Params,
    dt: Float[Array, " time"] | Float[Array, ""],
) -> Predict:
    """One step from channels to channels.

    Args:
        scene: the block's scene, with contact or without.
        params: one hypothesis.
        dt: length of all steps, or of each; if of all, what depends on it and on the
            hypothesis alone is worked out once.
    """
    if dt.ndim == 0 and isinstance(scene, Scene):
        prepared = prepare_step(scene, params, dt=dt)
        return lambda state, action, length, may_touch: (
            prepared(state_from_array(state), action)[0].array
        )

    def predict(state, action, length, may_touch):
        length = dt if length is None else length
        return predict_step(scene, params, state, action, length)

    if isinstance(scene, Scene):
        return predict
    apart = predictor(scene.apart, params, dt)
    return lambda state, action, length, may_touch: where_near(
        may_touch,
        lambda: predict(state, action, length, None),
        lambda: apart(state, action, length, None),
    )


def where_near(
    may_touch: BoolScalar | None, near: Callable[[], Any], apart: Callable[[], Any]
) -> Any:
    """What holds where bodies may touch, or what costs less where they cannot.

    Args:
        may_touch: the same for all points of a batch, else both are worked out. None:
            they may.
        near: with contact.
        apart: without.
    """
    return near() if may_touch is None else jax.lax.cond(may_touch, near, apart)


PredictChannels = Callable[
    [list, Float[Array, "1 3"], FloatScalar | None, BoolScalar | None], list
]
"""The same of one body, from a list of its channels to such a list."""


def channel_predictor(
    scene: Scene | ContactScene,
    params: Params,
    dt: Float[Array, " time"] | Float[Array, ""],
) -> PredictChannels:
    """One step of one body, channel by channel.

    Args:
        scene: the body's scene, with contact or without.
        params: one hypothesis.
        dt: as for `predictor`.
    """
    if dt.ndim == 0 and isinstance(scene, Scene):
        prepared = prepare_step(scene, params, dt=dt)
        return lambda state, action, length, may_touch: list(
            next_motion(prepared, Motion(*state), action)
        )
    predict = predictor(scene, params, dt)
    return lambda state, action, length, may_touch: _split_channels(
        predict(_join_channels(state), action, length, may_touch)
    )


Cloud = Callable[
    [
        Float[Array, "point body 6"],
        Float[Array, "body 3"],
        FloatScalar | None,
        BoolScalar | None,
    ],
    Float[Array, "point body 6"],
]
"""The same for an estimate and its neighbours, the estimate first."""


def cloud_predictor(
    scene: Scene | ContactScene,
    params: Params,
    dt: Float[Array, " time"] | Float[Array, ""],
) -> Cloud:
    """One step of an estimate and its neighbours, for differences between them.

    Args:
        scene: the block's scene. With contact neighbours collide in the same step as
            the estimate does.
        params: one hypothesis.
        dt: as for `predictor`.
    """
    if isinstance(scene, Scene):
        predict = predictor(scene, params, dt)
        return lambda points, action, length, may_touch: jax.vmap(
            lambda state: predict(state, action, length, None)
        )(points)

    near = near_cloud_predictor(scene, params, dt)
    apart = cloud_predictor(scene.apart, params, dt)
    return lambda points, action, length, may_touch: where_near(
        may_touch,
        *(lambda to=to: to(points, action, length, None) for to in (near, apart)),
    )


def near_cloud_predictor(
    scene: ContactScene, params: Params, dt: Float[Array, " time"] | Float[Array, ""]
) -> Cloud:
    """The same with contact in all rows."""

    def near(points, action, length, may_touch):
        length = dt if length is None else length
        impact = first_impact(scene, params, points[0], action, length)
        return jax.vmap(
            lambda state: contact_step(scene, params, state, action, length, impact)
        )(points)

    return near


def innovations(
    scene: Scene | ContactScene,
    params: Params,
    data: TrackData,
    gains: Gains,
    is_used: Bool[Array, " time"] | None = None,
    place: IntScalar | None = None,
) -> Float[Array, "time 2 body 6"]:
    """Whitened innovations of all readings, zero where nothing was read.

    Args:
        scene: the block's scene.
        params: one hypothesis.
        data: the block's readings.
        gains: of the hypothesis's structure.
        is_used: as `scan_used` has it.
        place: which of many gains, whose axis comes after that of time; None: there is
            but one.

    Returns:
        Of the reading that a row starts from and of the one that it ends at;
        independent and of unit variance if hypothesis, gains and noise are right.
    """
    shape, dt = data.steps.state.shape[1:], data.steps.dt
    data = with_delay(params, data)
    if math.prod(shape) > _MAX_WRITTEN_OUT:
        predict = predictor(scene, params, dt)

        def advance(state, inputs):
            row, gains = inputs
            if place is not None:
                gains = jax.tree.map(lambda leaf: leaf[place], gains)
            return track_row(predict, state, row, gains)

        return scan_used(advance, jnp.zeros(shape), (data.rows, gains), is_used)[1]
    assert place is None
    predict_channels = channel_predictor(scene, params, dt)

    # Channel by channel from row to row: a batch of points is then a vector for each,
    # and all arithmetic is on vectors. As one array of channels for each point the
    # same takes twice as long.
    def advance_channels(channels, inputs):
        return _track_channels(predict_channels, channels, *inputs)

    start = list(jnp.zeros(math.prod(shape)))
    _, whitened = scan_used(advance_channels, start, (data.rows, gains), is_used)
    return jnp.stack(whitened, axis=-1).reshape(-1, 2, *shape)


def track_row(
    predict: Predict, state: Float[Array, "body 6"], row: TrackRow, gains: Gains
) -> tuple[Float[Array, "body 6"], Float[Array, "2 body 6"]]:
    """Take a state through one row.

    Args:
        predict: one step of a hypothesis.
        state: best guess before the row.
        row: its readings.
        gains: for the row.

    Returns:
        The best guess after it, and the whitened innovations of its two readings.
    """

    def correct(state, reading, mask, gain, whitening):
        error = mask * channel_difference(reading, state)
        moved = state + _apply(gain, error)
        return moved, _apply(whitening, error, is_lower=True)

    state = jnp.where(row.is_start > 0, row.start, state)
    state, first_error = correct(
        state, row.first, row.first_mask, gains.first, gains.first_whitening
    )
    state = predict(state, row.action, row.dt, row.may_touch)
    state, last_error = correct(
        state, row.last, row.last_mask, gains.last, gains.last_whitening
    )
    return state, jnp.stack([first_error, last_error])


def _track_channels(predict: PredictChannels, state: list, row: TrackRow, gains: Gains):
    """As `track_row` for one body, whose channels stay apart from row to row.

    Worth it in a scan only: the online step, which keeps states as arrays, takes half
    as long again this way.
    """

    def correct(state, reading, mask, gain, whitening):
        difference = channel_differences(reading, state)
        error = [mask[0, i] * x for i, x in enumerate(difference)]
        moved = [x + _dot(gain[i], error) for i, x in enumerate(state)]
        return moved, [_dot(whitening[i], error[: i + 1]) for i in range(len(error))]

    state = [
        jnp.where(row.is_start > 0, row.start[0, i], x) for i, x in enumerate(state)
    ]
    state, first_error = correct(
        state, row.first, row.first_mask, gains.first, gains.first_whitening
    )
    state = predict(state, row.action, row.dt, row.may_touch)
    state, last_error = correct(
        state, row.last, row.last_mask, gains.last, gains.last_whitening
    )
    return state, first_error + last_error


def _split_channels(state: Float[Array, "1 6"]) -> list:
    """One by one: by slices, which take nothing where channels were just joined."""
    each = [jax.lax.slice_in_dim(state, i, i + 1, axis=1) for i in range(6)]
    return [x.reshape(()) for x in each]


def _join_channels(channels: Sequence) -> Float[Array, "1 6"]:
    """Back to channels of one body."""
    return jnp.concatenate([x.reshape(1, 1) for x in channels], axis=1)


def _dot(row, vector: list):
    terms = [row[i] * x for i, x in enumerate(vector)]
    return sum(terms[1:], terms[0])


def _apply(matrix, vector: Float[Array, "body 6"], *, is_lower: bool = False):
    """Matrix times channels, written out where there are few."""
    flat = vector.reshape(-1)
    num = flat.shape[0]
    if num > _MAX_WRITTEN_OUT:
        # Not as a product of matrices: a batch of those is worked at one by one.
        return jnp.sum(matrix * flat[None], axis=1).reshape(vector.shape)
    rows = []
    for i in range(num):
        terms = [matrix[i, j] * flat[j] for j in range(i + 1 if is_lower else num)]
        rows.append(sum(terms[1:], terms[0]))
    return jnp.stack(rows).reshape(vector.shape)
