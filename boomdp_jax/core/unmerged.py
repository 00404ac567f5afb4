"""Keep XLA's CPU backend from compiling a whole loop as one function."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.holding import hold


def unmerged(value: Float[Array, "..."]) -> Float[Array, "..."]:
    """The value itself; a loop that works it out is run operation by operation.

    The CPU backend of jaxlib 0.12 (0.10 did not) writes loops as one function, however
    long their body is. For substeps of ten bodies in contact the compiler then takes
    150 seconds instead of 18, and what it makes is four times slower; so is a loop over
    the steps of many lone bodies, and ten times with wheels, since what is inside it is
    no longer done for several of the batch at once. It does so only with loops in which
    nothing is sorted: here two numbers are, which costs a microsecond.

    Args:
        value: what the loop changes; not a constant of it.

    Returns:
        The value, to the bit. On other backends nothing is done to it.
    """
    return jax.lax.platform_dependent(value, cpu=_sorted_along, default=lambda v: v)


def _sorted_along(value):
    return hold(value, one_by_sorting(value.reshape(-1)[0]))


def one_by_sorting(number: Float[Array, ""]) -> Float[Array, ""]:
    """One, as what a sort of two numbers yields: what `unmerged` is made of.

    Args:
        number: what the loop changes.

    Returns:
        One, which the compiler cannot foresee.
    """
    number = jax.lax.stop_gradient(number)
    one = jnp.ones((), number.dtype)
    # Which of the two it is, the compiler cannot foresee; the first is always one.
    pair = jnp.stack([jnp.where(number > 0.0, 3.0, 2.0).astype(number.dtype), one])
    return jax.lax.sort(pair)[0]
