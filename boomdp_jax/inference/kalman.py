r"""An extended Kalman filter through the step: gains and marginal likelihood.

The state is latent; with A the derivative of the step at the filtered mean,

$$P^- = A P A^T + A G Q G^T A^T, \quad S = H P^- H^T + R, \quad
  K = P^- H^T S^{-1}, \quad P = (1 - K H) P^- (1 - K H)^T + K R K^T.$$

Linearised at the filtered mean, never at the readings: noise in the derivative would be
correlated with the innovation. Process noise is an impulse on the twist before the
step, G, so that joints and wheels hold it as they hold a push. Each track starts at its
first reading with that reading's covariance. Särkkä (2013), Bayesian Filtering and
Smoothing, algorithm 5.4.

The derivative is by differences of about the readings' noise, which averages over kinks
finer than that (a foot that sticks or slips).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.inference.track_data import TrackData
from boomdp_jax.inference.tracking import Gains, channel_difference, predictor
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene

# Standard deviation of a channel whose first reading is missing: pose [m, m, rad], then
# twist [m/s, m/s, rad/s].
_UNKNOWN_START = (1.0, 1.0, 3.0, 1.0, 1.0, 3.0)
_GROUP = (0, 0, 1, 2, 2, 3)


class NoiseLevel(eqx.Module):
    """Noise of readings and of the motion itself, per body."""

    reading: Float[Array, "*batch body 4"]
    """Sd of position [m], angle [rad], velocity [m/s] and spin [rad/s]."""
    impulse: Float[Array, "*batch body 2"]
    """Sd of the change of velocity [m/s] and spin [rad/s] that a step starts with."""


class Filtered(NamedTuple):
    """What a filter finds."""

    gains: Gains
    log_likelihood: FloatScalar


def channel_scale(reading):
    """Noise of every channel `[body, 6]` from that of the groups `[body, 4]`."""
    return reading[:, np.asarray(_GROUP)]


def kick_scale(impulse):
    """Sd of the kicks of channels `[body, 6]` from that of impulses `[body, 2]`."""
    rest = jnp.zeros_like(impulse[:, :1])
    slow, spin = impulse[:, :1], impulse[:, 1:]
    return jnp.concatenate([rest, rest, rest, slow, slow, spin], axis=-1)


def start_scale(num_bodies: int):
    """Sd of every channel of a start that was not read, body by body."""
    return jnp.tile(jnp.asarray(_UNKNOWN_START), num_bodies)


def extended_filter(
    scene: Scene, params: Params, data: TrackData, noise: NoiseLevel
) -> Filtered:
    """Filter all rows at one hypothesis.

    Args:
        scene: the block's scene.
        params: the hypothesis.
        data: the block's readings.
        noise: of readings and motion.

    Returns:
        Gains, and the log-density of all readings but the first of each track.
    """
    steps = data.steps
    predict = predictor(scene, params, steps.dt)
    num_bodies = steps.state.shape[1]
    num = 6 * num_bodies
    scale = channel_scale(noise.reading).reshape(-1)
    variance = jnp.diag(scale**2)
    kick = kick_scale(noise.impulse).reshape(-1)
    unknown = start_scale(num_bodies)
    offsets = jnp.diag(scale).reshape(num, num_bodies, 6)

    def update(state, covariance, reading, mask):
        """One reading: new mean and covariance, gain, whitening, log-density."""
        mask = mask.reshape(-1)
        error = mask[:, None] * covariance * mask[None] + variance * mask[:, None]
        error = error + jnp.diag(1.0 - mask)
        factor = jnp.linalg.cholesky(error)
        whitening = jax.scipy.linalg.solve_triangular(factor, jnp.eye(num), lower=True)
        gain = (covariance * mask[None]) @ (whitening.T @ whitening)
        whitening = mask[:, None] * whitening * mask[None]
        miss = channel_difference(reading, state).reshape(-1) * mask
        rest = jnp.eye(num) - gain * mask[None]
        covariance = rest @ covariance @ rest.T + gain @ variance @ gain.T
        state = state + (gain @ miss).reshape(state.shape)
        diagonal = jnp.diagonal(whitening)
        log_density = jnp.sum(
            jnp.where(diagonal > 0, jnp.log(jnp.where(diagonal > 0, diagonal, 1.0)), 0)
        ) - 0.5 * jnp.sum((whitening @ miss) ** 2)
        log_density = log_density - 0.5 * jnp.sum(mask) * jnp.log(2.0 * jnp.pi)
        return state, covariance, gain, whitening, log_density

    def advance(carry, row):
        state, covariance, total = carry
        is_start, is_second, start, first, first_mask, action, last, last_mask, dt = row
        first_covariance = jnp.diag(
            jnp.where(first_mask.reshape(-1) > 0, scale, unknown) ** 2
        )
        state = jnp.where(is_start > 0, start, state)
        covariance = jnp.where(is_start > 0, first_covariance, covariance)
        state, covariance, first_gain, first_whitening, density = update(
            state, covariance, first, is_second * first_mask
        )
        total = total + density
        points = jnp.concatenate([state[None], state[None] + offsets])
        images = jax.vmap(lambda x: predict(x, action, dt))(points)
        state = images[0]
        slope = (images[1:] - images[:1]).reshape(num, num).T / scale[None]
        spread = covariance + jnp.diag(kick**2)
        covariance = slope @ spread @ slope.T
        covariance = 0.5 * (covariance + covariance.T)
        state, covariance, last_gain, last_whitening, density = update(
            state, covariance, last, last_mask
        )
        gains = Gains(first_gain, last_gain, first_whitening, last_whitening)
        return (state, covariance, total + density), gains

    rows = (
        data.is_start,
        data.is_second,
        data.start,
        steps.state,
        data.first_mask,
        steps.action,
        steps.next_state,
        data.last_mask,
        steps.dt if steps.dt.ndim else None,
    )
    carry = (jnp.zeros((num_bodies, 6)), jnp.eye(num), jnp.zeros(()))
    (_, _, total), gains = jax.lax.scan(advance, carry, rows)
    return Filtered(gains, total)
