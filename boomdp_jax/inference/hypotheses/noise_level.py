r"""Noise of readings and of the motion as a vector of logarithms, and its prior.

Variances of readings are a priori inverse-gamma of shape one, as in `one_step`; the sd
of the impulses is log-normal about a tenth of the prior scale of velocity and spin
readings. It is broad: an impulse that the data do not show must be free to be nothing,
and has to be kept from wandering off.
"""

from typing import NamedTuple

import numpy as np

_IMPULSE_SHARE, IMPULSE_SPREAD = 0.1, 2.0
NUM_EACH = 6
"""Numbers of a body: position, angle, velocity, spin; impulses of the last two."""


class NoiseFit(NamedTuple):
    """Noise of a list of points, on the host."""

    reading: np.ndarray
    """Sd of position [m], angle [rad], velocity [m/s] and spin [rad/s], `[point, body,
    4]`."""
    impulse: np.ndarray
    """Sd of the change of velocity [m/s] and spin [rad/s] that a step starts with,
    `[point, body, 2]`."""

    @property
    def vector(self) -> np.ndarray:
        """Logarithms, `[point, number]`."""
        both = np.concatenate([self.reading, self.impulse], axis=-1)
        return np.log(both).reshape(len(both), -1)

    @classmethod
    def of_vector(cls, vector: np.ndarray) -> "NoiseFit":
        """From logarithms `[point, number]`."""
        # Far beyond any noise, and still a number in single precision.
        both = np.exp(np.clip(vector, -80.0, 80.0))
        both = both.reshape(len(vector), -1, NUM_EACH)
        return cls(both[..., :4], both[..., 4:])

    def take(self, rows: np.ndarray) -> "NoiseFit":
        """Some of them."""
        return NoiseFit(self.reading[rows], self.impulse[rows])

    def where(self, rows: np.ndarray, others: "NoiseFit") -> "NoiseFit":
        """Some of them, and elsewhere those of another list."""
        each = rows[:, None, None]
        return NoiseFit(
            np.where(each, self.reading, others.reading),
            np.where(each, self.impulse, others.impulse),
        )


def log_noise_prior(scale: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Log-density of the logarithms.

    Args:
        scale: prior scale of the readings of each point's object, `[point, 4]`.
        vector: `[point, number]`.

    Returns:
        `[point]`.
    """
    both = vector.reshape(len(vector), -1, NUM_EACH)
    log_scale = np.log(scale)[:, None]
    log_ratio = 2.0 * (log_scale - both[..., :4])
    reading = np.log(2.0) + log_ratio - np.exp(log_ratio)
    middle = np.log(_IMPULSE_SHARE) + log_scale[..., 2:]
    offset = (both[..., 4:] - middle) / IMPULSE_SPREAD
    impulse = -0.5 * offset**2 - np.log(IMPULSE_SPREAD) - 0.5 * np.log(2.0 * np.pi)
    return np.sum(reading, axis=(1, 2)) + np.sum(impulse, axis=(1, 2))


def prior_noise(
    rng: np.random.Generator, scale: np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Draw noise from its prior.

    Args:
        rng: source of randomness.
        scale: prior scale of the readings, `[4]`.
        shape: of the draws.

    Returns:
        Sds of readings `[*shape, 4]` and of impulses `[*shape, 2]`.
    """
    reading = scale / np.sqrt(rng.gamma(1.0, size=(*shape, 4)))
    normal = IMPULSE_SPREAD * rng.standard_normal((*shape, 2))
    return reading, _IMPULSE_SHARE * scale[2:] * np.exp(normal)
