"""What an agent can do: a list of wrenches, one of which is held over each step."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import IntScalar


class ActionSet(eqx.Module):
    """Wrenches to choose from; an agent's action is an index into them."""

    wrench: Float[Array, "action body 3"]
    """At the centres of mass, world frame [N, N, N m]."""

    @property
    def num_actions(self) -> int:
        """How many there are."""
        return self.wrench.shape[0]

    def __getitem__(self, action: IntScalar | int) -> Float[Array, "body 3"]:
        """The wrench that an action stands for.

        While JAX traces, an index out of range is that of the nearest one in it.

        Raises:
            TypeError: no whole number.
            ValueError: not one of the actions.
        """
        if isinstance(action, jax.core.Tracer):
            return self.wrench[jnp.clip(action, 0, self.num_actions - 1)]
        index = np.asarray(action)
        if index.dtype.kind not in "iu" or index.ndim:
            raise TypeError(
                f"action: expected a whole number below {self.num_actions}, got "
                f"{action!r}"
            )
        if not 0 <= index < self.num_actions:
            raise ValueError(
                f"action: expected a number from 0 to {self.num_actions - 1}, got "
                f"{int(index)}"
            )
        return self.wrench[action]


def forces_round_circle(
    num_bodies: int,
    body: int,
    force: float,
    num_directions: int = 8,
    *,
    torque: float = 0.0,
    with_nothing: bool = True,
) -> ActionSet:
    """Forces on one body in directions that divide the circle evenly.

    Args:
        num_bodies: of the scene.
        body: index of the one that is pushed.
        force: of each push [N].
        num_directions: how many, the first along the x axis.
        torque: pure torques of this size both ways are added, if it is not 0 [N m].
        with_nothing: whether to add the action that does nothing.

    Returns:
        The actions, in this order.

    Raises:
        ValueError: no such body, no direction, or a force that is not positive.
    """
    if not 0 <= body < num_bodies:
        raise ValueError(f"body: expected an index below {num_bodies}, got {body}")
    if num_directions < 1:
        raise ValueError(f"num_directions: expected at least 1, got {num_directions}")
    if not (np.isfinite(force) and force > 0):
        raise ValueError(f"force: expected positive newtons, got {force}")
    if not (np.isfinite(torque) and torque >= 0):
        raise ValueError(f"torque: expected newton metres of at least 0, got {torque}")
    angle = 2 * np.pi * np.arange(num_directions) / num_directions
    rows = [np.stack([force * np.cos(angle), force * np.sin(angle), 0 * angle], 1)]
    if torque:
        rows.append(np.array([[0.0, 0.0, torque], [0.0, 0.0, -torque]]))
    if with_nothing:
        rows.append(np.zeros((1, 3)))
    own = np.concatenate(rows)
    wrench = np.zeros((len(own), num_bodies, 3))
    wrench[:, body] = own
    return ActionSet(jnp.asarray(wrench, float))


def join_actions(sets: Sequence[ActionSet]) -> ActionSet:
    """All actions of several sets, in order.

    Raises:
        ValueError: none, or sets for scenes of different numbers of bodies.
    """
    shapes = {actions.wrench.shape[1:] for actions in sets}
    if len(shapes) != 1:
        raise ValueError(
            "sets: expected at least one, all for the same number of bodies; got "
            f"{sorted(shape[0] for shape in shapes)}"
        )
    return ActionSet(jnp.concatenate([actions.wrench for actions in sets]))
