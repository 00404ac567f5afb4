"""All random numbers of one proposal from a single call of the generator.

Each call costs half a second of compilation on a processor; a proposal that split its
key and drew from every part would spend most of a program's compile time on that.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from boomdp_jax.core.arrays import FloatScalar, IntScalar, Key

NUM_CHOICES = 4


class Noise(NamedTuple):
    """Independent random numbers, enough for any one proposal and its verdict."""

    choice: Float[Array, " choice"]
    """Uniform over (0, 1)."""
    turn: Float[Array, " dim"]
    """Uniform over (-1/2, 1/2)."""
    normal: Float[Array, " dim"]
    square: Float[Array, " square"]
    """Squares of standard normals."""

    def chi_square(self, degrees_of_freedom: IntScalar | int) -> FloatScalar:
        """A chi-square number; at most as many degrees as there are squares."""
        is_counted = jnp.arange(self.square.shape[-1]) < degrees_of_freedom
        return jnp.sum(jnp.where(is_counted, self.square, 0.0))


def draw_noise(key: Key, dim: int, degrees_of_freedom: int) -> Noise:
    """Draw what a proposal over `dim` coordinates needs.

    Args:
        key: random key.
        dim: coordinates of the target.
        degrees_of_freedom: of the mixture; there are `dim` squares more.
    """
    parts = (NUM_CHOICES, dim, dim, degrees_of_freedom + dim)
    low = jnp.nextafter(jnp.asarray(-1.0, float), jnp.asarray(0.0, float))
    flat = jax.random.uniform(key, (sum(parts),), minval=low, maxval=1.0)
    ends = [sum(parts[:index]) for index in range(1, len(parts))]
    choice, turn, normal, square = jnp.split(flat, ends)
    return Noise(
        choice=0.5 * (1.0 + choice),
        turn=0.5 * turn,
        normal=_to_normal(normal),
        square=_to_normal(square) ** 2,
    )


def pick(log_weight: Float[Array, " option"], uniform: FloatScalar) -> Int[Array, ""]:
    """Choose an index with probability in proportion to exp(log-weight).

    Args:
        log_weight: need not be normalised; minus infinity is never chosen unless all
            are.
        uniform: random number in (0, 1).
    """
    highest = jnp.max(log_weight)
    weight = jnp.exp(log_weight - jnp.where(jnp.isfinite(highest), highest, 0.0))
    cumulative = jnp.cumsum(weight)
    index = jnp.sum(cumulative <= uniform * cumulative[-1])
    return jnp.minimum(index, log_weight.shape[-1] - 1).astype(jnp.int32)


def _to_normal(uniform: Float[Array, " num"]) -> Float[Array, " num"]:
    """Turn numbers uniform over (-1, 1) into standard normal ones."""
    return jnp.sqrt(2.0).astype(uniform.dtype) * jax.lax.erf_inv(uniform)
