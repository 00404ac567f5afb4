"""Which states count as the same: those whose coordinates are in one cell of a grid."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PyTree

# Cells further out than this count as one; twice as far still is an integer of 32 bit.
_LARGEST = 2.0**30


class Grid(eqx.Module):
    """Which states count as the same."""

    coordinates_fn: Callable[[Any], Any]
    cell_size: Float[Array, " channel"]

    def coordinates(self, state: PyTree) -> Float[Array, " channel"]:
        """Where a state is, in units of its own."""
        return jnp.asarray(self.coordinates_fn(state), self.cell_size.dtype)

    def cell(self, state: PyTree) -> Int[Array, " channel"]:
        """The cell that a state is in; of no meaning if it is not finite."""
        cell = jnp.nan_to_num(jnp.floor(self.coordinates(state) / self.cell_size))
        return jnp.clip(cell, -_LARGEST, _LARGEST).astype(jnp.int32)


def make_grid(
    coordinates_fn: Callable[[Any], Any] | None, cell_size: Any, state: PyTree
) -> Grid:
    """Check a grid against a state.

    Args:
        coordinates_fn: `state -> [channel]`; none: all numbers in the state.
        cell_size: in units of the coordinates, one number or one for each.
        state: any that is to be told apart from others.

    Returns:
        The grid.

    Raises:
        TypeError: `coordinates_fn` is not a function.
        ValueError: coordinates that are not a vector, another number of cell sizes than
            of coordinates, a size that is not positive.
    """
    if coordinates_fn is None:
        coordinates_fn = _all_numbers
    if not callable(coordinates_fn):
        raise TypeError(f"coordinates_fn: expected a function; got {coordinates_fn!r}")
    shape = jax.eval_shape(
        lambda state: jnp.asarray(coordinates_fn(state)), state
    ).shape
    if len(shape) != 1 or not shape[0]:
        raise ValueError(f"coordinates_fn: expected a vector; got shape {shape}")
    if jnp.shape(cell_size) not in ((), shape):
        raise ValueError(
            f"cell_size: expected one number or {shape[0]}, as many as there are "
            f"coordinates; got shape {jnp.shape(cell_size)}"
        )
    is_concrete = not isinstance(cell_size, Tracer)
    if is_concrete and not np.all(np.asarray(cell_size) > 0):
        raise ValueError(f"cell_size: expected positive numbers; got {cell_size}")
    return Grid(coordinates_fn, jnp.broadcast_to(jnp.asarray(cell_size, float), shape))


def _all_numbers(state: PyTree) -> Float[Array, " channel"]:
    return ravel_pytree(state)[0].astype(float)
