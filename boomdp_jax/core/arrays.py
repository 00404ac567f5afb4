"""Array aliases: the shapes and dtypes that the rest of the package speaks in."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

FloatScalar = Float[Array, ""]
IntScalar = Int[Array, ""]
BoolScalar = Bool[Array, ""]
Vector2 = Float[Array, "*batch 2"]
Key = PRNGKeyArray

__all__ = [
    "BoolScalar",
    "FloatScalar",
    "IntScalar",
    "Key",
    "Vector2",
    "on_device",
    "row_of",
]


def on_device(values: Any, dtype: type | np.dtype = float) -> Array:
    """An array of JAX from numbers on the host, converted there.

    `jnp.asarray` compiles a program for every new shape, ten to thirty milliseconds
    each, which set-up code with its many small arrays pays in seconds.

    Args:
        values: concrete numbers, as NumPy takes them.
        dtype: `float`, `int` and `bool` stand for the default type of that kind.

    Returns:
        The same numbers.
    """
    # A copy, since the result may share its memory.
    return jax.device_put(np.array(values, jax.dtypes.canonicalize_dtype(dtype)))


@jax.jit
def row_of(tree: PyTree, index: int | IntScalar) -> PyTree:
    """A row of every array of a tree, in one call.

    Array by array, each takes a quarter of a millisecond: a belief has sixty.

    Args:
        tree: of arrays with a common leading axis.
        index: of the row.

    Returns:
        The arrays without that axis.
    """
    return jax.tree.map(
        lambda leaf: jax.lax.dynamic_index_in_dim(leaf, index, keepdims=False), tree
    )
