"""Which states count as the same: those whose coordinates are in one cell of a grid.

A state's coordinates are its numbers, or what the user's function makes of them (a
heading as its remainder, say). Cells are centred at zero, where things like to rest.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PyTree, UInt32

CoordinatesFn = Callable[[Any], Any]

# Cells farther out than this all count as one: an int32 holds no more.
_FARTHEST = 2.0**30


class Grid(eqx.Module):
    """Which states count as the same."""

    coordinates_fn: CoordinatesFn
    cell_size: Float[Array, " channel"]
    """In units of the coordinates; channels of infinite size do not tell apart."""

    def coordinates(self, state: PyTree) -> Float[Array, " channel"]:
        """Where a state is, in units of its own."""
        return jnp.asarray(self.coordinates_fn(state), self.cell_size.dtype)

    def cell(self, state: PyTree) -> Int[Array, " channel"]:
        """The cell that a state is in; of no meaning if it is not finite."""
        cell = jnp.nan_to_num(jnp.round(self.coordinates(state) / self.cell_size))
        return jnp.clip(cell, -_FARTHEST, _FARTHEST).astype(jnp.int32)


def make_grid(
    coordinates_fn: CoordinatesFn | None,
    cell_size: Any,
    state: PyTree,
    *,
    name: str = "cell_size",
) -> Grid:
    """Check a grid against a state.

    Args:
        coordinates_fn: `state -> [channel]`; none: all numbers in the state.
        cell_size: in units of the coordinates, one number or one for each.
        state: any that is to be told apart from others.
        name: what the caller calls the size.

    Returns:
        The grid.

    Raises:
        TypeError: `coordinates_fn` is not a function.
        ValueError: coordinates that are not a vector, another number of sizes than of
            coordinates, a size that is not positive.
    """
    if coordinates_fn is None:
        coordinates_fn = all_numbers
    if not callable(coordinates_fn):
        raise TypeError(f"coordinates_fn: expected a function; got {coordinates_fn!r}")
    shape = jax.eval_shape(
        lambda state: jnp.asarray(coordinates_fn(state)), state
    ).shape
    if len(shape) != 1 or not shape[0]:
        raise ValueError(f"coordinates_fn: expected a vector; got shape {shape}")
    is_concrete = not isinstance(cell_size, Tracer)
    if is_concrete:
        cell_size = np.asarray(cell_size, float)
    if jnp.shape(cell_size) not in ((), shape):
        raise ValueError(
            f"{name}: expected one number or {shape[0]}, as many as there are "
            f"coordinates; got shape {jnp.shape(cell_size)}"
        )
    if is_concrete and not np.all(np.asarray(cell_size) > 0):
        raise ValueError(f"{name}: expected positive numbers; got {cell_size}")
    return Grid(coordinates_fn, jnp.broadcast_to(jnp.asarray(cell_size, float), shape))


def all_numbers(state: PyTree) -> Float[Array, " channel"]:
    """A state's leaves, one after the other."""
    return ravel_pytree(state)[0].astype(float)


def hash_of(cells: Int[Array, "node channel"]) -> UInt32[Array, " node"]:
    """Numbers that are equal for equal cells, and hardly ever for others."""
    mixed = jnp.full(cells.shape[0], 0x9E3779B9, jnp.uint32)
    for channel in range(cells.shape[1]):
        # One round of the finaliser of MurmurHash3 for each channel.
        mixed = mixed ^ (cells[:, channel].astype(jnp.uint32) * jnp.uint32(0xCC9E2D51))
        mixed = (mixed ^ (mixed >> 16)) * jnp.uint32(0x85EBCA6B)
        mixed = (mixed ^ (mixed >> 13)) * jnp.uint32(0xC2B2AE35)
    return mixed ^ (mixed >> 16)
