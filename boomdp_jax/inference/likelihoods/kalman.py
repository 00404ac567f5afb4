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
finer than that (a foot that sticks or slips). Of a twist that is known less well than
that, as where a track begins and nobody reads velocities, they are as large as what is
not known: friction that stops whatever is slower than a reading's noise would else pass
for one that stops all, and take away in one step what nobody knows.

Where bodies collide whose twists are hardly known, as soon after a track begins, what
becomes of them bends too much for a derivative: of discs of which two or three readings
came before the impact, 90 % intervals then hold 0.65 to 0.85 of the truth ever after.
Predictions start from filters that take such rows by second differences along the axes
$s_k$ of $P + G Q G^T = \sum_k s_k s_k^T$, with $h^2 = 3$,

$$r_k = \frac{f(m + h s_k) - f(m - h s_k)}{2 h}, \quad
  b_k = \frac{f(m + h s_k) + f(m - h s_k) - 2 f(m)}{2 h^2},$$
$$m^- = f(m) + \sum_k b_k, \quad
  P^- = \sum_k \left(r_k r_k^T + (h^2 - 1)\, b_k b_k^T\right)$$

(Nørgaard, Poulsen and Ravn (2000), New developments in state estimation for nonlinear
systems, section 4), twice the steps that derivatives take.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.inference.hypotheses.contact_prediction import ContactScene
from boomdp_jax.inference.likelihoods.robust_update import correct_robustly
from boomdp_jax.inference.likelihoods.tracking import (
    Gains,
    channel_difference,
    cloud_predictor,
    near_cloud_predictor,
    where_near,
)
from boomdp_jax.inference.readings.track_data import TrackData, TrackRow, with_delay
from boomdp_jax.inference.readings.used_rows import scan_used
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene

# Standard deviation of a channel whose first reading is missing: pose [m, m, rad], then
# twist [m/s, m/s, rad/s].
_UNKNOWN_START = (1.0, 1.0, 3.0, 1.0, 1.0, 3.0)
_GROUP = (0, 0, 1, 2, 2, 3)
# h of second differences: right to fourth order of a normal.
_REACH = math.sqrt(3.0)


class NoiseLevel(eqx.Module):
    """Noise of readings and of the motion itself, per body."""

    reading: Float[Array, "*batch body 4"]
    """Sd of position [m], angle [rad], velocity [m/s] and spin [rad/s]."""
    impulse: Float[Array, "*batch body 2"]
    """Sd of the change of velocity [m/s] and spin [rad/s] that a step starts with."""


class Estimate(NamedTuple):
    """What a filter knows of the state at one instant."""

    mean: Float[Array, "*batch body 6"]
    covariance: Float[Array, "*batch channel channel"]


class FilteredRow(NamedTuple):
    """What a filter finds in one row."""

    gains: Gains
    log_likelihood: FloatScalar
    """Log-density of the row's readings given all before."""
    start: Float[Array, "body 6"]
    """Mean before the first reading of the row."""
    slope: Float[Array, "channel channel"]
    """Derivative of the row's step by the state before it; zero in rows that were
    taken by second differences."""


class Filtered(NamedTuple):
    """What a filter finds."""

    gains: Gains
    log_likelihood: FloatScalar
    starts: Float[Array, "time body 6"]
    """Mean before the first reading of each row."""
    after: Estimate
    """After each row, leading axis `time`."""
    slopes: Float[Array, "time channel channel"]
    """Derivative of each row's step by the state before it."""


def channel_scale(reading):
    """Noise of every channel `[body, 6]` from that of the groups `[body, 4]`."""
    return reading[:, np.asarray(_GROUP)]


def kick_scale(impulse):
    """Sd of the kicks of channels `[body, 6]` from that of impulses `[body, 2]`."""
    rest = jnp.zeros_like(impulse[:, :1])
    slow, spin = impulse[:, :1], impulse[:, 1:]
    return jnp.concatenate([rest, rest, rest, slow, slow, spin], axis=-1)


def neighbour_scale(scale, variance):
    """How far from an estimate its neighbours lie, along channels of a twist.

    Args:
        scale: noise of the readings.
        variance: of the estimate.

    Returns:
        The noise, or the estimate's sd where that is more.
    """
    return jnp.sqrt(jnp.maximum(scale**2, variance))


def neighbour_scales(scale, variance):
    """The same for all channels, body by body; noise alone along those of poses."""
    is_twist = np.arange(scale.shape[0]) % 6 >= 3
    return jnp.where(is_twist, neighbour_scale(scale, variance), scale)


def principal_axes(
    covariance: Float[Array, "channel channel"],
) -> Float[Array, "channel axis"]:
    """Axes of one sd each, of what may know some directions for certain.

    Args:
        covariance: of channels of unlike units.

    Returns:
        S with $S S^T$ the covariance; zero along directions that are certain.
    """
    variance = jnp.diagonal(covariance)
    sd = jnp.sqrt(jnp.maximum(variance, jnp.finfo(covariance.dtype).tiny))
    value, vector = jnp.linalg.eigh(covariance / (sd[:, None] * sd[None]))
    return sd[:, None] * vector * jnp.sqrt(jnp.maximum(value, 0.0))[None]


def start_scale(num_bodies: int):
    """Sd of every channel of a start that was not read, body by body."""
    return jnp.tile(jnp.asarray(_UNKNOWN_START), num_bodies)


def start_factor(freedom: float | None) -> float:
    """Sd over scale of the noise of a reading that a track starts from."""
    return 1.0 if freedom is None else math.sqrt(freedom / (freedom - 2.0))


class RowFilter:
    """Takes a hypothesis's estimate of the state from row to row."""

    def __init__(
        self,
        scene: Scene | ContactScene,
        params: Params,
        dt: Float[Array, " time"] | Float[Array, ""],
        noise: NoiseLevel,
        freedom: float | None = None,
        *,
        bends: bool = False,
    ):
        """Work out what does not change from row to row.

        Args:
            scene: the block's scene.
            params: the hypothesis.
            dt: as `TrackData.steps` has it.
            noise: of readings and motion.
            freedom: as `TrackData` has it.
            bends: whether rows in which bodies may touch go by second differences.
        """
        self._freedom = freedom
        num_bodies = noise.reading.shape[0]
        self._num = 6 * num_bodies
        self._near = None
        if bends and isinstance(scene, ContactScene):
            self._near = near_cloud_predictor(scene, params, dt)
            scene = scene.apart
        self._predict = cloud_predictor(scene, params, dt)
        self._scale = channel_scale(noise.reading).reshape(-1)
        self._variance = jnp.diag(self._scale**2)
        self._kick = kick_scale(noise.impulse).reshape(-1)
        self._unknown = start_scale(num_bodies)

    def start(self) -> Estimate:
        """To begin with, before any row; the first one starts a track."""
        return Estimate(jnp.zeros((self._num // 6, 6)), jnp.eye(self._num))

    @full_precision
    def at_start(self, before: Estimate, row: TrackRow) -> Estimate:
        """What is known at the start of a row, all readings until then taken in."""
        return self._begun(before, row)[1][0]

    @full_precision
    def __call__(self, before: Estimate, row: TrackRow) -> tuple[Estimate, FilteredRow]:
        """Filter one row."""
        start, first = self._begun(before, row)
        begun, first_gain, first_whitening, first_density = first
        if self._near is None:
            moved, slope = self._linear(begun, row)
        else:
            moved, slope = where_near(
                row.may_touch,
                lambda: self._second_order(begun, row),
                lambda: self._linear(begun, row),
            )
        estimate, last_gain, last_whitening, last_density = self._update(
            moved, row.last, row.last_mask
        )
        gains = Gains(first_gain, last_gain, first_whitening, last_whitening)
        density = first_density + last_density
        return estimate, FilteredRow(gains, density, start, slope)

    def _linear(self, before: Estimate, row: TrackRow):
        """Estimate after the row's step, and the derivative that it went by."""
        num, (state, covariance) = self._num, before
        offset = neighbour_scales(self._scale, jnp.diagonal(covariance))
        offsets = jnp.diag(offset).reshape(num, *state.shape)
        points = jnp.concatenate([state[None], state[None] + offsets])
        images = self._predict(points, row.action, row.dt, row.may_touch)
        slope = (images[1:] - images[:1]).reshape(num, num).T / offset[None]
        spread = covariance + jnp.diag(self._kick**2)
        covariance = slope @ spread @ slope.T
        covariance = 0.5 * (covariance + covariance.T)
        return Estimate(images[0], covariance), slope

    def _second_order(self, before: Estimate, row: TrackRow):
        """The same by second differences along the axes of what is not known."""
        assert self._near is not None
        num, (state, covariance) = self._num, before
        axis = principal_axes(covariance + jnp.diag(self._kick**2))
        offsets = _REACH * axis.T.reshape(num, *state.shape)
        points = state[None] + jnp.concatenate(
            [jnp.zeros_like(offsets[:1]), offsets, -offsets]
        )
        images = self._near(points, row.action, row.dt, None).reshape(-1, num)
        ahead, behind = images[1 : num + 1], images[num + 1 :]
        rise = (ahead - behind) / (2.0 * _REACH)
        bend = (ahead + behind - 2.0 * images[:1]) / (2.0 * _REACH**2)
        covariance = rise.T @ rise + (_REACH**2 - 1.0) * bend.T @ bend
        mean = images[0] + jnp.sum(bend, axis=0)
        estimate = Estimate(mean.reshape(state.shape), covariance)
        return estimate, jnp.zeros_like(covariance)

    def _begun(self, before: Estimate, row: TrackRow):
        """Mean before the first reading, and what that reading makes of it."""
        begin = row.is_start > 0
        known = start_factor(self._freedom) * self._scale
        first_sd = jnp.where(row.first_mask.reshape(-1) > 0, known, self._unknown)
        estimate = Estimate(
            jnp.where(begin, row.start, before.mean),
            jnp.where(begin, jnp.diag(first_sd**2), before.covariance),
        )
        return estimate.mean, self._update(estimate, row.first, row.is_second)

    @full_precision
    def _update(self, estimate: Estimate, reading, mask):
        """One reading: new mean and covariance, gain, whitening, log-density."""
        state, covariance = estimate
        mask, num, variance = mask.reshape(-1), self._num, self._variance
        miss = channel_difference(reading, state).reshape(-1) * mask
        robust = None
        if self._freedom is not None:
            robust = correct_robustly(
                covariance, miss, mask, self._scale**2, self._freedom
            )
            variance = jnp.diag(robust.variance)
        error = mask[:, None] * covariance * mask[None] + variance * mask[:, None]
        error = error + jnp.diag(1.0 - mask)
        factor = jnp.linalg.cholesky(error)
        whitening = jax.scipy.linalg.solve_triangular(factor, jnp.eye(num), lower=True)
        gain = (covariance * mask[None]) @ (whitening.T @ whitening)
        whitening = mask[:, None] * whitening * mask[None]
        rest = jnp.eye(num) - gain * mask[None]
        covariance = rest @ covariance @ rest.T + gain @ variance @ gain.T
        state = state + (gain @ miss).reshape(state.shape)
        diagonal = jnp.diagonal(whitening)
        log_density = jnp.sum(
            jnp.where(diagonal > 0, jnp.log(jnp.where(diagonal > 0, diagonal, 1.0)), 0)
        ) - 0.5 * jnp.sum((whitening @ miss) ** 2)
        log_density = log_density - 0.5 * jnp.sum(mask) * jnp.log(2.0 * jnp.pi)
        if robust is not None:
            state, _ = estimate
            state = state + robust.shift.reshape(state.shape)
            covariance, log_density = robust.covariance, robust.log_density
        return Estimate(state, covariance), gain, whitening, log_density


def extended_filter(
    scene: Scene | ContactScene,
    params: Params,
    data: TrackData,
    noise: NoiseLevel,
    is_used: Bool[Array, " time"] | None = None,
) -> Filtered:
    """Filter all rows at one hypothesis.

    Args:
        scene: the block's scene.
        params: the hypothesis.
        data: the block's readings.
        noise: of readings and motion.
        is_used: as `scan_used` has it.

    Returns:
        Gains, and the log-density of all readings but the first of each track, each
        row's as often as the row counts.
    """
    row_filter = RowFilter(scene, params, data.steps.dt, noise, data.freedom)
    data = with_delay(params, data)

    def advance(carry, row):
        estimate, total = carry
        estimate, found = row_filter(estimate, row)
        density = found.log_likelihood
        density = density if row.weight is None else row.weight * density
        kept = (found.gains, found.start, estimate, found.slope)
        return (estimate, total + density), kept

    carry = (row_filter.start(), jnp.zeros(()))
    (_, total), (gains, *rest) = scan_used(advance, carry, data.rows, is_used)
    return Filtered(gains, total, *rest)
