"""What every planner returns."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from boomdp_jax.core.arrays import FloatScalar, IntScalar


class SearchInfo(eqx.Module):
    """How the search went; what a planner has not is None."""

    num_model_calls: IntScalar
    """Calls of `transition_fn`, one for each step of the model."""
    num_nodes: Int[Array, "hypothesis level"] | None = None
    """States that were expanded, by level."""
    num_merged: Int[Array, "hypothesis level"] | None = None
    """Children of a level that fell in the cell of another one."""
    num_dropped: Int[Array, "hypothesis level"] | None = None
    """Cells of a level's children for which there was no room."""
    cell_size: Float[Array, " channel"] | None = None
    """Of the grid on which states were merged, in units of the coordinates."""


class Plan(eqx.Module):
    """An action, and why."""

    index: IntScalar
    """Of the chosen action; where actions are continuous, of the listed one that is
    nearest to it."""
    action: PyTree
    """The chosen action itself."""
    value: FloatScalar
    """Estimated return from the state on."""
    q_values: Float[Array, " action"] | None
    """Estimated return of each action; None where a planner has none."""
    hypothesis_q_values: Float[Array, "hypothesis action"] | None
    """The same under each hypothesis at the root."""
    sequence: PyTree
    """Actions planned from the first on, leading axis `level`, under the likeliest
    hypothesis; `previous` of the next decision, once the first was carried out."""
    info: SearchInfo
    tree: PyTree = None
    """Nodes by level, where asked for."""


def plan_of(sequence: PyTree) -> Plan:
    """A plan of which nothing but its actions is known, to be gone on with.

    Args:
        sequence: actions, leading axis `level`.
    """
    zero = jnp.zeros((), int)
    return Plan(
        index=zero,
        action=jax.tree.map(lambda leaf: leaf[0], sequence),
        value=jnp.full((), -jnp.inf),
        q_values=None,
        hypothesis_q_values=None,
        sequence=sequence,
        info=SearchInfo(num_model_calls=zero),
    )
