"""How large a cell should be: half of what a step moves each coordinate by."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from boomdp_jax.core.arrays import Key
from boomdp_jax.planning.expansion import Sample
from boomdp_jax.planning.grid import CoordinatesFn
from boomdp_jax.planning.problem import Problem

# Random sequences of actions from which a cell size is chosen, and the part of their
# steps' size that it is. On a pendulum and a cart round a wall, cells of one step or
# half a step work, three times that fails, and where cells are so fine that nothing
# merges the tree does too.
_NUM_SEQUENCES = 32
_PART_OF_STEP = 0.5


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
