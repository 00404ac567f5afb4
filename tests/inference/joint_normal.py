"""Readings of a free box as one normal vector: its density for any mass and noise."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.linalg import solve_triangular

from boomdp_jax.core.history import History
from tests.inference.recordings import response, transition_matrix

_CHANNEL = np.array([0, 0, 1, 2, 2, 3])
# Groups: position, angle, velocity, spin of readings; velocity, spin of kicks.
_KICK = np.array([-1, -1, -1, 4, 4, 5])


class JointNormal(NamedTuple):
    """Chained readings of one episode: linear in start error, kicks and noise."""

    value: Array
    mean: Array
    """At no force."""
    response: Array
    """Of the mean to one over the mass."""
    slope: Array
    """`[value, latent]`."""
    latent: np.ndarray
    """Noise group of each latent error."""
    group: np.ndarray
    """Noise group of each reading."""

    def log_density(self, mass: Array, log_noise: Array) -> Array:
        """Of all readings but the first.

        Args:
            mass: of the box [kg].
            log_noise: logarithms of four sds of readings and two of kicks.
        """
        variance = jnp.exp(2.0 * log_noise)
        slope = self.slope * jnp.exp(log_noise)[self.latent][None]
        covariance = slope @ slope.T + jnp.diag(variance[self.group])
        miss = self.value - self.mean - self.response / mass
        factor = jnp.linalg.cholesky(covariance)
        white = solve_triangular(factor, miss, lower=True)
        logs = jnp.sum(jnp.log(jnp.diagonal(factor)))
        num = miss.shape[0]
        return -0.5 * jnp.sum(white**2) - logs - 0.5 * num * jnp.log(2.0 * jnp.pi)


def joint_normal(history: History) -> JointNormal:
    """Write out the readings of a box that moves freely, in one chained episode."""
    state, action = np.asarray(history.state)[:, 0], np.asarray(history.action)[:, 0]
    last = np.asarray(history.next_state)[:, 0]
    matrix, unit = transition_matrix(), response(1.0)
    kicked = np.flatnonzero(_KICK >= 0)
    mean, pushed = state[0], np.zeros(6)
    num_rows = len(action)
    slope = np.zeros((6, 6 + 3 * num_rows))
    slope[:, :6] = np.eye(6)
    means, responses, slopes = [], [], []
    for t in range(num_rows):
        begin = 6 + 3 * t
        slope = slope.copy()
        slope[kicked, begin : begin + 3] += np.eye(3)
        mean, slope = matrix @ mean, matrix @ slope
        pushed = matrix @ pushed + unit @ action[t]
        means.append(mean)
        responses.append(pushed)
        slopes.append(slope)
    return JointNormal(
        value=jnp.asarray(last.reshape(-1)),
        mean=jnp.asarray(np.concatenate(means)),
        response=jnp.asarray(np.concatenate(responses)),
        slope=jnp.asarray(np.concatenate(slopes)),
        latent=np.concatenate([_CHANNEL, np.tile(_KICK[kicked], num_rows)]),
        group=np.tile(_CHANNEL, num_rows),
    )
