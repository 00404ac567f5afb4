"""Scans over a table's rows that pass over what is padding at its end.

Tables hold room for rows to come, so that nothing is compiled anew when they do. What a
filter does at such rows is worth nothing, and in most tables they are the most.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

# Rows are passed over by so many at most at a time, since to pass over takes time too.
_MOST_AT_A_TIME = 16


def scan_used(
    advance: Callable[[Any, Any], tuple[Any, Any]],
    carry: Any,
    rows: Any,
    is_used: Bool[Array, " time"] | None,
) -> tuple[Any, Any]:
    """`jax.lax.scan` over the rows in use.

    Args:
        advance: from what is carried, and a row, to both afterwards.
        carry: to begin with.
        rows: leading axis `time`.
        is_used: which rows count; None: all of them. Some that do not may be gone
            through all the same, and must do no harm. Where calls are batched this must
            be the same for all of a batch, else nothing is saved.

    Returns:
        What is carried in the end, and what was found in each row: zeros in rows that
        were passed over.
    """
    if is_used is None:
        return jax.lax.scan(advance, carry, rows)
    num = is_used.shape[0]
    # Compiled with the rest, but its Python runs once for both uses below.
    advance = jax.jit(advance)
    size = max(n for n in range(1, _MOST_AT_A_TIME + 1) if num % n == 0)

    def split(leaf: Array) -> Array:
        return leaf.reshape(-1, size, *leaf.shape[1:])

    def step(carry, inputs):
        are_used, some = inputs
        first = jax.tree.map(lambda leaf: leaf[0], some)
        _, found = jax.eval_shape(advance, carry, first)
        nothing = jax.tree.map(
            lambda leaf: jnp.zeros((size, *leaf.shape), leaf.dtype), found
        )
        return jax.lax.cond(
            jnp.any(are_used),
            lambda: jax.lax.scan(advance, carry, some),
            lambda: (carry, nothing),
        )

    split_rows = jax.tree.map(split, rows)
    carry, found = jax.lax.scan(step, carry, (split(is_used), split_rows))
    return carry, jax.tree.map(lambda x: x.reshape(num, *x.shape[2:]), found)
