r"""A policy's numbers between −1 and 1, as a wrench no greater than a task's own.

A task lists wrenches; what pushes the same bodies is one way of acting. Of a single
body such a way has a number each for the force along x, the force along y and the
torque, as far as the list has any, in units of its greatest force F and its greatest
torque T; of several bodies at once, as a motor between two links, one number along the
wrench that the list repeats. The numbers a are drawn back into the unit ball,

$$w = (F a_x, F a_y, T a_\tau) / \max(1, |a|),$$

so that forces fill the disc and a greatest force leaves no room for a torque, as in the
list. Where a task lets one of several bodies be pushed at a time, there is one more
number for each, and the body whose number is greatest is pushed.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.envs.action_set import ActionSet


class ContinuousActions(eqx.Module):
    """Wrenches for vectors of numbers between −1 and 1."""

    basis: Float[Array, "way number body 3"]
    """Wrench of each number at 1, for each way of acting [N, N, N m]; ways of fewer
    numbers end in rows of zeros."""

    @property
    def num_ways(self) -> int:
        """Among how many a policy chooses at each step."""
        return self.basis.shape[0]

    @property
    def size(self) -> int:
        """Numbers of an action: of a way, then one for each way if there are more."""
        numbers = self.basis.shape[1]
        return numbers + (self.num_ways if self.num_ways > 1 else 0)

    @full_precision
    def wrench(self, action: Float[Array, " number"]) -> Float[Array, "body 3"]:
        """The wrench that an action stands for.

        Args:
            action: numbers; those beyond −1 and 1 are taken for these.

        Returns:
            On every body, world frame [N, N, N m].

        Raises:
            ValueError: more or fewer numbers than `size`.
        """
        if jnp.shape(action) != (self.size,):
            raise ValueError(
                f"action: expected shape ({self.size},), got {jnp.shape(action)}"
            )
        action = jnp.clip(action, -1.0, 1.0)
        num_numbers = self.basis.shape[1]
        way = 0 if self.num_ways == 1 else jnp.argmax(action[num_numbers:])
        basis = self.basis[way].astype(action.dtype)
        is_used = jnp.any(basis != 0.0, axis=(1, 2))
        numbers = jnp.where(is_used, action[:num_numbers], 0.0)
        square = jnp.sum(numbers**2)
        length = jnp.sqrt(jnp.maximum(square, 1.0))
        return jnp.tensordot(numbers / length, basis, axes=1)


def continuous_actions(actions: ActionSet) -> ContinuousActions:
    """Fill in what lies between a task's wrenches.

    Args:
        actions: concrete.

    Returns:
        A way of acting for each body, or group of bodies, that some of them push, in
        the order of the list.

    Raises:
        ValueError: they push nothing, or several bodies at once by wrenches that are
            not multiples of one.
    """
    wrench = np.asarray(actions.wrench, float)
    is_pushed = np.any(wrench != 0.0, axis=2)
    groups = list(dict.fromkeys(map(tuple, is_pushed[np.any(is_pushed, axis=1)])))
    if not groups:
        raise ValueError("actions: expected some that push a body, got none")
    ways = [
        _way(wrench[np.all(is_pushed == np.array(group), axis=1)]) for group in groups
    ]
    most = max(len(way) for way in ways)
    filled = [np.pad(way, ((0, most - len(way)), (0, 0), (0, 0))) for way in ways]
    return ContinuousActions(jnp.asarray(np.stack(filled), float))


def _way(wrench: np.ndarray) -> np.ndarray:
    """Wrenches at 1 of the numbers that fill in some of the same bodies."""
    bodies = np.flatnonzero(np.any(wrench != 0.0, axis=(0, 2)))
    if len(bodies) > 1:
        return _along_one(wrench)
    own = wrench[:, bodies[0]]
    greatest = np.max(np.linalg.norm(own[:, :2], axis=1)), np.max(np.abs(own[:, 2]))
    scale = np.diag([greatest[0], greatest[0], greatest[1]])
    scale = scale[np.any(scale != 0.0, axis=1)]
    way = np.zeros((len(scale), *wrench.shape[1:]))
    way[:, bodies[0]] = scale
    return way


def _along_one(wrench: np.ndarray) -> np.ndarray:
    """The greatest of wrenches that lie on one line; of opposite ones, the last."""
    rows = wrench.reshape(len(wrench), -1)
    length = np.linalg.norm(rows, axis=1)
    last = len(rows) - 1 - int(np.argmax(length[::-1]))
    along = rows[last] / length[last]
    aside = np.max(np.abs(rows - np.outer(rows @ along, along)))
    if aside > 1e-6 * length[last]:
        raise ValueError(
            "actions: expected wrenches on several bodies at once to be multiples of "
            f"one, got others {aside:.3g} aside of {wrench[last].tolist()}"
        )
    return wrench[last][None]
