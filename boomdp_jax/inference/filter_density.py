r"""Marginal likelihood of noisy readings by an extended Kalman filter, for many points.

The same filter as `kalman.extended_filter`, whose docstring has the equations, but no
gains are kept and nothing is factorised: readings are taken one channel at a time, as
noise of one channel is independent of that of the next (Bierman 1977, Factorization
methods for discrete sequential estimation).
"""

import jax
import jax.numpy as jnp

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.inference.contact_prediction import ContactScene
from boomdp_jax.inference.filter_update import correct, move_and_correct
from boomdp_jax.inference.kalman import (
    NoiseLevel,
    channel_scale,
    kick_scale,
    start_factor,
    start_scale,
)
from boomdp_jax.inference.robust_update import correct_robustly, move
from boomdp_jax.inference.track_data import TrackData, with_delay
from boomdp_jax.inference.tracking import channel_difference, cloud_predictor
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene


def filter_density(
    scene: Scene | ContactScene,
    params: Params,
    data: TrackData,
    noise: NoiseLevel,
) -> FloatScalar:
    """Log-density of all readings but the first of each track.

    Args:
        scene: the block's scene.
        params: the hypothesis.
        data: the block's readings.
        noise: of readings and motion.

    Returns:
        The same as `extended_filter` gives. To be batched by `jax.vmap`.
    """
    data = with_delay(params, data)
    steps = data.steps
    predict = cloud_predictor(scene, params, steps.dt)
    num_bodies = steps.state.shape[1]
    num = 6 * num_bodies
    scale = channel_scale(noise.reading).reshape(-1)
    at_first = start_factor(data.freedom) * scale
    unknown = start_scale(num_bodies)
    variance, kick = scale**2, kick_scale(noise.impulse).reshape(-1) ** 2
    offsets = jnp.diag(scale).reshape(num, num_bodies, 6)

    def advance(carry, row):
        state, covariance, total = carry
        seen = row.first_mask.reshape(-1)
        at_start = jnp.diag(jnp.where(seen > 0, at_first, unknown) ** 2)
        state = jnp.where(row.is_start > 0, row.start, state)
        covariance = jnp.where(row.is_start > 0, at_start, covariance)
        miss = channel_difference(row.first, state).reshape(-1)
        shift, covariance, first_density = _correct(
            covariance, miss, row.is_second * seen, variance, data.freedom
        )
        state = state + shift.reshape(state.shape)
        points = jnp.concatenate([state[None], state[None] + offsets])
        images = predict(points, row.action, row.dt)
        state = images[0]
        rise = (images[1:] - state[None]).reshape(num, num)
        miss = channel_difference(row.last, state).reshape(-1)
        mask = row.last_mask.reshape(-1)
        if data.freedom is None:
            shift, covariance, last_density = move_and_correct(
                covariance, rise, scale, kick, miss, mask, variance
            )
        else:
            covariance = move(covariance, rise, scale, kick)
            shift, covariance, last_density = _correct(
                covariance, miss, mask, variance, data.freedom
            )
        state = state + shift.reshape(state.shape)
        density = first_density + last_density
        density = density if row.weight is None else row.weight * density
        return (state, covariance, total + density), None

    carry = (jnp.zeros((num_bodies, 6)), jnp.eye(num), jnp.zeros(()))
    return jax.lax.scan(advance, carry, data.rows)[0][2]


def _correct(covariance, miss, mask, variance, freedom: float | None):
    """By normal or by Student-t noise: shift, covariance, log-density."""
    if freedom is None:
        return correct(covariance, miss, mask, variance)
    return correct_robustly(covariance, miss, mask, variance, freedom)[:3]
