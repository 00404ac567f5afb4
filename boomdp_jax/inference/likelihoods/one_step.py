r"""Likelihood of single steps, with the noise scales integrated out or given.

Each recorded step is predicted from its own first reading,
$s'_t = F_\Phi(s_t, a_t) + \epsilon_t$ (equation 1 of "What Does Physics Bias").
The noise of each channel group g (position, angle, velocity, spin) of each body has its
own variance with an inverse-gamma prior of shape a = 1 and rate $b_g$; with n residuals
of sum of squares S the marginal likelihood is

$$\log p = a \log b - \log\Gamma(a) + \log\Gamma(a + n/2) - (a + n/2)\log(b + S/2)
  - \tfrac{n}{2} \log 2\pi,$$

and given the residuals the variance is inverse-gamma(a + n/2, b + S/2).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import FloatScalar, Key
from boomdp_jax.inference.hypotheses.contact_prediction import (
    ContactScene,
    predict_step,
)
from boomdp_jax.inference.hypotheses.coordinates import Coordinates
from boomdp_jax.inference.readings.single_steps import Readings, in_effect
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene

NOISE_SHAPE = 1.0
"""Shape of the inverse-gamma prior of a noise variance."""

# Channel group of x, y, theta, xdot, ydot, thetadot.
_GROUP = (0, 0, 1, 2, 2, 3)


class NoiseStatistics(NamedTuple):
    """Sufficient statistics of the noise, per body and channel group."""

    num: Float[Array, "body 4"]
    square: Float[Array, "body 4"]
    """Sum of squared residuals."""


def residuals(
    scene: Scene | ContactScene, params: Params, data: Readings
) -> Float[Array, "time body 6"]:
    """Predicted minus read, zero where nothing was read.

    Args:
        scene: the block's scene.
        params: one hypothesis.
        data: the block's readings.

    Returns:
        Differences of positions [m], angles [rad], velocities and spins.
    """

    def predict(state, action, dt):
        return predict_step(scene, params, state, action, dt)

    in_axes = (0, 0, 0 if data.dt.ndim else None)
    predicted = jax.vmap(predict, in_axes)(data.state, in_effect(params, data), data.dt)
    difference = jnp.where(data.mask > 0, predicted - data.next_state, 0.0)
    angle = difference[..., 2]
    turns = jax.lax.stop_gradient(jnp.round(angle / (2.0 * jnp.pi)))
    return difference.at[..., 2].set(angle - 2.0 * jnp.pi * turns)


def group_sums(values: Float[Array, "time body 6"]) -> Float[Array, "body 4"]:
    """Sum over time and over the channels of each group."""
    total = jnp.sum(values, axis=0)
    return jnp.stack(
        [
            total[:, 0] + total[:, 1],
            total[:, 2],
            total[:, 3] + total[:, 4],
            total[:, 5],
        ],
        axis=-1,
    )


def noise_statistics(
    scene: Scene | ContactScene, params: Params, data: Readings
) -> NoiseStatistics:
    """Counts and sums of squares of the residuals."""
    difference = residuals(scene, params, data)
    return NoiseStatistics(group_sums(data.mask), group_sums(difference**2))


def log_marginal(statistics: NoiseStatistics, scale: Float[Array, " 4"]) -> FloatScalar:
    """Log-likelihood with every noise variance integrated out.

    Args:
        statistics: counts and sums of squares.
        scale: scale of each group's inverse-gamma prior; its rate is the square.

    Returns:
        Sum over bodies and groups.
    """
    rate = scale[None] ** 2
    shape = NOISE_SHAPE + 0.5 * statistics.num
    each = (
        NOISE_SHAPE * jnp.log(rate)
        - jax.scipy.special.gammaln(NOISE_SHAPE)
        + jax.scipy.special.gammaln(shape)
        - shape * jnp.log(rate + 0.5 * statistics.square)
        - 0.5 * statistics.num * jnp.log(2.0 * jnp.pi)
    )
    return jnp.sum(each)


def draw_noise(
    key: Key, statistics: NoiseStatistics, scale: Float[Array, " 4"]
) -> Float[Array, "body 4"]:
    """Noise scales given the residuals, from their inverse-gamma distribution."""
    shape = NOISE_SHAPE + 0.5 * statistics.num
    rate = scale[None] ** 2 + 0.5 * statistics.square
    return jnp.sqrt(rate / jax.random.gamma(key, shape))


def noise_precision(
    statistics: NoiseStatistics, scale: Float[Array, " 4"]
) -> Float[Array, "body 6"]:
    """Weight of a squared residual in the gradient of `log_marginal`, per channel."""
    shape = NOISE_SHAPE + 0.5 * statistics.num
    each = shape / (scale[None] ** 2 + 0.5 * statistics.square)
    return each[:, jnp.asarray(_GROUP)]


class OneStepLikelihood(eqx.Module):
    """Log-likelihood of coordinates and active slots; what samplers call."""

    coordinates: Coordinates
    data: Readings

    def __call__(
        self, z: Float[Array, " dim"], active: Bool[Array, " slot"]
    ) -> FloatScalar:
        """Log marginal likelihood, -1e30 where the prediction is not finite."""
        return self.log_marginal(self.statistics(z, active))

    def log_marginal(self, statistics: NoiseStatistics) -> FloatScalar:
        """The same from statistics."""
        value = log_marginal(statistics, self.coordinates.scales.noise)
        return jnp.where(jnp.isfinite(value), value, -1e30)

    def statistics(
        self, z: Float[Array, " dim"], active: Bool[Array, " slot"]
    ) -> NoiseStatistics:
        """Counts and sums of squares at a hypothesis."""
        params = self.coordinates(z, active)
        return noise_statistics(self.coordinates.world, params, self.data)

    def residuals(
        self, z: Float[Array, " dim"], active: Bool[Array, " slot"]
    ) -> Float[Array, "time body 6"]:
        """Residuals at a hypothesis."""
        params = self.coordinates(z, active)
        return residuals(self.coordinates.world, params, self.data)
