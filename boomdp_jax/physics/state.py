"""How bodies move at one instant: pose and twist, Markov, nothing cached."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class State(eqx.Module):
    """Pose and twist of every body's centre of mass, world frame."""

    pose: Float[Array, "*batch body 3"]
    """x, y [m] and theta [rad], counter-clockwise, not wrapped."""
    twist: Float[Array, "*batch body 3"]
    """Rates of the pose [m/s, rad/s]."""

    @property
    def array(self) -> Float[Array, "*batch body 6"]:
        """Pose and twist side by side, as data files hold them."""
        return jnp.concatenate([self.pose, self.twist], axis=-1)


def state_from_array(array: Float[Array, "*batch body 6"]) -> State:
    """Split x, y, theta, xdot, ydot, thetadot into a state."""
    return State(pose=array[..., :3], twist=array[..., 3:])
