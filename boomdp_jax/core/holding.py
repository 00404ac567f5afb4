"""Keep a compiler from computing the same thing again in every consumer."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def runtime_one(positive: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Ones that the compiler cannot foresee, from numbers that are positive."""
    return jax.lax.stop_gradient(jnp.where(positive > 0, 1.0, positive))


@jax.custom_jvp
def hold(value: Float[Array, "..."], one: Float[Array, "..."]) -> Float[Array, "..."]:
    """The value itself, computed once and stored.

    XLA's CPU backend fuses elementwise code by repeating it in every consumer, which
    for a chain of small solves costs ten to ten thousand times the operations. It does
    not repeat a division. Dividing by a one that it cannot foresee is exact, and cheap
    beside what it saves; an optimisation barrier would not do, since the backend drops
    barriers before it fuses.

    Args:
        value: what several others use and takes more than a few operations to compute.
        one: from `runtime_one`.

    Returns:
        The value, to the bit. Derivatives are held likewise.
    """
    return value / one


@hold.defjvp
def _hold_jvp(primals, tangents):
    (value, one), (rate, _) = primals, tangents
    return hold(value, one), rate / one
