"""What is left to do of a batch, done for a few lanes at a time.

A loop over a batch goes on until the last lane is done, and costs as much in its last
turn as in its first. Where few lanes are left after some turns it pays to take those
out, and to put them back when they are done.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

Known = TypeVar("Known")
Found = TypeVar("Found")


def few_at_a_time(
    function: Callable[[Known, Found], Found],
    is_open: Bool[Array, " lane"],
    known: Known,
    found: Found,
    at_a_time: int,
) -> Found:
    """Apply a function to the lanes of which something is left to do.

    Args:
        function: from what is known of lanes and what is found of them to what is found
            then, of any number of lanes, none of which depends on another.
        is_open: where it is wanted.
        known: tree of arrays `[..., lane]`.
        found: tree of such arrays; also what it stays elsewhere.
        at_a_time: lanes that the function is called for.

    Returns:
        What is found then.
    """
    num = is_open.shape[-1]
    count = jnp.cumsum(is_open.astype(jnp.int32))
    # Open lanes in order, then a number that is none's.
    place = jnp.where(is_open, count - 1, num + at_a_time)
    order = jnp.full(num + at_a_time, num, jnp.int32)
    order = order.at[place].set(jnp.arange(num, dtype=jnp.int32), mode="drop")

    def go_on(carry: tuple) -> tuple:
        begin, found = carry
        lanes = jax.lax.dynamic_slice(order, (begin,), (at_a_time,))

        def taken(leaf: Array) -> Array:
            # Where there are fewer, the last lane stands in, and is not put back.
            return leaf.at[..., lanes].get(mode="clip")

        few = function(*jax.tree.map(taken, (known, found)))
        found = jax.tree.map(
            lambda leaf, part: leaf.at[..., lanes].set(part, mode="drop"), found, few
        )
        return begin + at_a_time, found

    start = jnp.zeros((), jnp.int32), found
    return jax.lax.while_loop(lambda carry: carry[0] < count[-1], go_on, start)[1]
