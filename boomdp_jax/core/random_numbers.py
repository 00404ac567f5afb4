"""All random numbers of one proposal from a single call of the generator.

Each call costs half a second of compilation on a processor; a proposal that split its
key and drew from every part would spend most of a program's compile time on that.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from boomdp_jax.core.arrays import FloatScalar, IntScalar, Key, on_device

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


def host_generator(key: Key) -> np.random.Generator:
    """A generator on the host that follows from a key.

    Batches of random numbers for compiled programs are drawn on the host where they are
    small beside the work: a program that draws its own takes seconds longer to compile.
    """
    return np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel())


def host_noise(
    rng: np.random.Generator,
    shape: tuple[int, ...],
    dim: int,
    degrees_of_freedom: int,
    dtype: np.dtype,
) -> Noise:
    """The same as `draw_noise`, for a batch of proposals, drawn on the host."""

    def normal(num: int) -> np.ndarray:
        return rng.standard_normal((*shape, num))

    return Noise(
        choice=on_device(_open_unit(rng, (*shape, NUM_CHOICES)), dtype),
        turn=on_device(_open_unit(rng, (*shape, dim)) - 0.5, dtype),
        normal=on_device(normal(dim), dtype),
        square=on_device(normal(degrees_of_freedom + dim) ** 2, dtype),
    )


def _open_unit(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Uniform over (0, 1), so that single precision reaches neither end."""
    return np.clip(rng.random(shape), 1e-7, 1.0 - 1e-7)


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
