r"""Marginal likelihood of noisy readings by an extended Kalman filter, for many points.

The same filter as `kalman.extended_filter`, whose docstring has the equations, but no
gains are kept and nothing is factorised: readings are taken one channel at a time, as
noise of one channel is independent of that of the next (Bierman 1977, Factorization
methods for discrete sequential estimation).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.inference.hypotheses.contact_prediction import ContactScene
from boomdp_jax.inference.likelihoods.filter_update import (
    correct,
    move,
    move_and_correct,
    move_and_correct_channels,
    start_and_correct_channels,
)
from boomdp_jax.inference.likelihoods.kalman import (
    NoiseLevel,
    channel_scale,
    kick_scale,
    neighbour_scale,
    neighbour_scales,
    start_factor,
    start_scale,
)
from boomdp_jax.inference.likelihoods.robust_update import correct_robustly
from boomdp_jax.inference.likelihoods.tracking import (
    PredictChannels,
    channel_difference,
    channel_differences,
    channel_predictor,
    cloud_predictor,
)
from boomdp_jax.inference.readings.track_data import TrackData, TrackRow, with_delay
from boomdp_jax.inference.readings.used_rows import scan_used
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene


def filter_density(
    scene: Scene | ContactScene,
    params: Params,
    data: TrackData,
    noise: NoiseLevel,
    is_used: Bool[Array, " time"] | None = None,
) -> FloatScalar:
    """Log-density of all readings but the first of each track.

    Args:
        scene: the block's scene.
        params: the hypothesis.
        data: the block's readings.
        noise: of readings and motion.
        is_used: as `scan_used` has it.

    Returns:
        The same as `extended_filter` gives. To be batched by `jax.vmap`.
    """
    data = with_delay(params, data)
    if isinstance(scene, Scene) and data.freedom is None and scene.num_bodies == 1:
        return _density_of_one_body(scene, params, data, noise, is_used)
    steps = data.steps
    predict = cloud_predictor(scene, params, steps.dt)
    num_bodies = steps.state.shape[1]
    num = 6 * num_bodies
    scale = channel_scale(noise.reading).reshape(-1)
    at_first = start_factor(data.freedom) * scale
    unknown = start_scale(num_bodies)
    variance, kick = scale**2, kick_scale(noise.impulse).reshape(-1) ** 2

    def advance(carry, row):
        state, covariance, total = carry
        seen = row.first_mask.reshape(-1)
        at_start = jnp.diag(jnp.where(seen > 0, at_first, unknown) ** 2)
        state = jnp.where(row.is_start > 0, row.start, state)
        covariance = jnp.where(row.is_start > 0, at_start, covariance)
        miss = channel_difference(row.first, state).reshape(-1)
        shift, covariance, first_density = _correct(
            covariance, miss, row.is_second.reshape(-1), variance, data.freedom
        )
        state = state + shift.reshape(state.shape)
        offset = neighbour_scales(scale, jnp.diagonal(covariance))
        offsets = jnp.diag(offset).reshape(num, num_bodies, 6)
        points = jnp.concatenate([state[None], state[None] + offsets])
        images = predict(points, row.action, row.dt, row.may_touch)
        state = images[0]
        rise = (images[1:] - state[None]).reshape(num, num)
        miss = channel_difference(row.last, state).reshape(-1)
        mask = row.last_mask.reshape(-1)
        if data.freedom is None:
            shift, covariance, last_density = move_and_correct(
                covariance, rise, offset, kick, miss, mask, variance
            )
        else:
            covariance = move(covariance, rise, offset, kick)
            shift, covariance, last_density = _correct(
                covariance, miss, mask, variance, data.freedom
            )
        state = state + shift.reshape(state.shape)
        density = first_density + last_density
        density = density if row.weight is None else row.weight * density
        return (state, covariance, total + density), None

    carry = (jnp.zeros((num_bodies, 6)), jnp.eye(num), jnp.zeros(()))
    return scan_used(advance, carry, data.rows, is_used)[0][2]


def _density_of_one_body(
    scene: Scene,
    params: Params,
    data: TrackData,
    noise: NoiseLevel,
    is_used: Bool[Array, " time"] | None,
) -> FloatScalar:
    """The same channel by channel, each a vector in a batch of points."""
    predict = channel_predictor(scene, params, data.steps.dt)
    predict_all = _cloud_of_channels(predict, data.rows)
    scale = channel_scale(noise.reading).reshape(-1)
    at_first = list((start_factor(data.freedom) * scale) ** 2)
    unknown = list(start_scale(1) ** 2)
    variance, kick = list(scale**2), list(kick_scale(noise.impulse).reshape(-1) ** 2)
    # The estimate, and each neighbour that is moved along one channel.
    is_moved = jnp.concatenate([jnp.zeros((1, 6)), jnp.eye(6)])
    num = range(6)

    def advance(carry, row):
        state, lower, total = carry
        seen = [row.first_mask[0, i] for i in num]
        at_start = [jnp.where(seen[i] > 0, at_first[i], unknown[i]) for i in num]
        state = [
            jnp.where(row.is_start > 0, row.start[0, i], x) for i, x in enumerate(state)
        ]
        shift, lower, first_density = start_and_correct_channels(
            row.is_start,
            at_start,
            lower,
            channel_differences(row.first, state),
            [row.is_second[0, i] for i in num],
            variance,
        )
        state = [x + move for x, move in zip(state, shift, strict=True)]
        offset = [
            scale[i] if i < 3 else neighbour_scale(scale[i], lower[i][i]) for i in num
        ]
        points = [x + offset[i] * is_moved[:, i] for i, x in enumerate(state)]
        images = predict_all(points, row)
        state = [image[0] for image in images]
        shift, lower, last_density = move_and_correct_channels(
            lower,
            [[image[k + 1] - image[0] for image in images] for k in num],
            offset,
            kick,
            channel_differences(row.last, state),
            [row.last_mask[0, i] for i in num],
            variance,
        )
        state = [x + move for x, move in zip(state, shift, strict=True)]
        density = first_density + last_density
        density = density if row.weight is None else row.weight * density
        return (state, lower, total + density), None

    zero, one = jnp.zeros(()), jnp.ones(())
    lower = [[one if i == j else zero for j in range(i + 1)] for i in num]
    carry = ([zero for _ in num], lower, zero)
    return scan_used(advance, carry, data.rows, is_used)[0][2]


def _cloud_of_channels(predict: PredictChannels, rows: TrackRow):
    """One step of an estimate and its six neighbours, each channel a vector.

    What a hypothesis has worked out beforehand is copied for each of the seven here,
    once, and not in every row.
    """

    def one(row: TrackRow, *point):
        return predict(list(point), row.action, row.dt, row.may_touch)

    first = jax.tree.map(lambda leaf: leaf[0], rows)
    pure, known = jax.closure_convert(one, first, *jnp.zeros(6))
    known = [jnp.broadcast_to(leaf, (7, *leaf.shape)) for leaf in known]

    def predict_all(points: list, row: TrackRow) -> list:
        return jax.vmap(lambda point, known: pure(row, *point, *known))(points, known)

    return predict_all


def _correct(covariance, miss, mask, variance, freedom: float | None):
    """By normal or by Student-t noise: shift, covariance, log-density."""
    if freedom is None:
        return correct(covariance, miss, mask, variance)
    return correct_robustly(covariance, miss, mask, variance, freedom)[:3]
