"""A grid over states: which of them are the same for a planner.

A state's coordinates are its numbers, or what the user's function makes of them (a
heading as its remainder, say). Cells are centred at zero, where things like to rest.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PyTree, UInt32

from boomdp_jax.core.arrays import Key
from boomdp_jax.planning.expansion import Sample
from boomdp_jax.planning.problem import Problem

CoordinatesFn = Callable[[Any], Any]

# Cells farther out than this all count as one: an int32 holds no more.
_FARTHEST = 2.0**30
# Random sequences of actions from which a cell size is chosen, and the part of their
# steps' size that it is. On a pendulum and a cart round a wall, cells of one step or
# half a step work, three times that fails, and where cells are so fine that nothing
# merges the tree does too.
_NUM_SEQUENCES = 32
_PART_OF_STEP = 0.5


def all_numbers(state: PyTree) -> Float[Array, " channel"]:
    """A state's leaves, one after the other."""
    return ravel_pytree(state)[0].astype(float)


def cells_of(
    coordinates: Float[Array, "node channel"], size: Float[Array, " channel"]
) -> Int[Array, "node channel"]:
    """Which cell each state lies in; channels of infinite size do not tell apart."""
    place = jnp.round(coordinates / size[None])
    return jnp.clip(place, -_FARTHEST, _FARTHEST).astype(jnp.int32)


def hash_of(cells: Int[Array, "node channel"]) -> UInt32[Array, " node"]:
    """Numbers that are equal for equal cells, and hardly ever for others."""
    mixed = jnp.full(cells.shape[0], 0x9E3779B9, jnp.uint32)
    for channel in range(cells.shape[1]):
        # One round of the finaliser of MurmurHash3 for each channel.
        mixed = mixed ^ (cells[:, channel].astype(jnp.uint32) * jnp.uint32(0xCC9E2D51))
        mixed = (mixed ^ (mixed >> 16)) * jnp.uint32(0x85EBCA6B)
        mixed = (mixed ^ (mixed >> 13)) * jnp.uint32(0xC2B2AE35)
    return mixed ^ (mixed >> 16)


def cell_size_from_steps(
    key: Key,
    problem: Problem,
    sample: Sample,
    coordinates_fn: CoordinatesFn,
    state: PyTree,
    depth: int,
) -> Float[Array, " channel"]:
    """Half of what one step moves each coordinate by, on random sequences of actions.

    Args:
        key: random key.
        problem: actions.
        sample: the model.
        coordinates_fn: coordinates of a state.
        state: where the sequences start.
        depth: steps of a sequence.

    Returns:
        Half of the root mean square of a step's displacement. Infinite for coordinates
        that nothing moves. It costs `num_calls_for_cell_size` calls of the model.
    """
    action_key, transition_key = jax.random.split(key)
    shape = (_NUM_SEQUENCES, depth)
    sequences = jax.random.randint(action_key, shape, 0, problem.num_actions)

    def displacements(number, sequence):
        sequence_key = jax.random.fold_in(transition_key, number)

        def one(state, step):
            action = problem.action(sequence[step])
            outcome, _ = sample(jax.random.fold_in(sequence_key, step), state, action)
            moved = coordinates_fn(outcome.state) - coordinates_fn(state)
            return outcome.state, moved

        return jax.lax.scan(one, state, jnp.arange(depth))[1]

    moved = jax.vmap(displacements)(jnp.arange(_NUM_SEQUENCES), sequences)
    # One wild step, or one that is not finite, is not to make one cell of the world.
    moved = jnp.where(jnp.isfinite(moved), moved, 0.0)
    square = moved.reshape(-1, moved.shape[-1]) ** 2
    bound = 9.0 * jnp.median(square, axis=0)[None]
    square = jnp.where(bound > 0, jnp.minimum(square, bound), square)
    size = _PART_OF_STEP * jnp.sqrt(jnp.mean(square, axis=0))
    return jnp.where(size > 0, size, jnp.inf)


def num_calls_for_cell_size(depth: int, action_repeat: int) -> int:
    """What `cell_size_from_steps` asks of the model."""
    return _NUM_SEQUENCES * depth * action_repeat


def check_size(name: str, size: Float[Array, "..."]) -> None:
    """Raise unless a size that is known now is positive.

    Raises:
        ValueError: zero, negative or not a number.
    """
    if not isinstance(size, jax.core.Tracer) and not np.all(np.asarray(size) > 0):
        raise ValueError(f"{name}: expected positive sizes; got {np.asarray(size)}")


def size_of_each(
    name: str, size: Float[Array, "..."], num_channels: int
) -> Float[Array, " channel"]:
    """A size for each coordinate, from one for all or one for each.

    Raises:
        ValueError: sizes of another number of coordinates.
    """
    if size.shape not in ((), (num_channels,)):
        raise ValueError(
            f"{name}: expected one number, or one for each of the {num_channels} "
            f"coordinates of a state; got shape {size.shape}"
        )
    return jnp.broadcast_to(size, (num_channels,))
