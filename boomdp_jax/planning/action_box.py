"""Between listed actions and a continuum: the box that they span, the nearest of them.

Planners over continuous actions work in coordinates of that box, so that their step
lengths need no units.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from boomdp_jax.core.arrays import IntScalar
from boomdp_jax.planning.problem import Problem


class Box(eqx.Module):
    """The smallest box around the listed actions; its coordinates run from −1 to 1."""

    centre: Float[Array, " dim"]
    half_width: Float[Array, " dim"]

    def actions(self, z: Float[Array, "level dim"]) -> Float[Array, "level dim"]:
        """From coordinates of the box."""
        return self.centre[None] + self.half_width[None] * z

    def coordinates(
        self, actions: Float[Array, "level dim"]
    ) -> Float[Array, "level dim"]:
        """Of actions in the box; one outside is moved to its edge."""
        width = jnp.where(self.half_width > 0, self.half_width, 1.0)
        z = (actions - self.centre[None]) / width[None]
        return jnp.clip(z, -1.0, 1.0)


def action_box(actions: PyTree) -> Box:
    """Span a box by the listed actions.

    Args:
        actions: one array of floats `[action, dim]`.

    Returns:
        The box.

    Raises:
        ValueError: anything else.
    """
    is_vectors = (
        eqx.is_array(actions)
        and actions.ndim == 2
        and jnp.issubdtype(actions.dtype, jnp.floating)
    )
    if not is_vectors:
        raise ValueError(
            "actions: continuous actions span a box, which takes one array of floats "
            f"[action, dim]; got {eqx.tree_pformat(actions)}"
        )
    low, high = jnp.min(actions, axis=0), jnp.max(actions, axis=0)
    return Box((low + high) / 2, (high - low) / 2)


def nearest(problem: Problem, action: PyTree) -> IntScalar:
    """Index of the listed action next to one, each number in units of its range."""

    def distance(listed, one):
        listed = listed.reshape(listed.shape[0], -1).astype(float)
        width = jnp.ptp(listed, axis=0)
        gap = (listed - one.reshape(1, -1)) / jnp.where(width > 0, width, 1.0)[None]
        return jnp.sum(gap**2, axis=1)

    distances = jax.tree.map(distance, problem.actions, action)
    return jnp.argmin(sum(jax.tree.leaves(distances)))
