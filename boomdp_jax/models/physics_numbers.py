r"""Which physics a point estimate chooses from: all constraints on, nulled by value.

Every moving body has a density, a wheel and a floor beneath it, whether it needs them
or not; a friction that is not there is one whose coefficient goes to zero. Numbers are
coordinates of size one, free from minus to plus infinity:

- logarithms of the density, of the wheel's viscous coefficients over the body's mass
  [1/s] and of its dry limits over the weight, each rolling and lateral, of the floor's
  viscous coefficient over the mass [1/s], and of its coefficient of dry friction;
- the wheel's place as a share of the outline's reach, $r \sin z$, and its heading.

With a pin there are, besides, the anchor's place in the body, likewise, and a gate: the
pin holds where the gate is positive. The point of the world it holds to is where the
anchor was on average, so that a pin never pulls a body across the room.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.physics.params import WORLD, Params, Revolute, empty_params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.scene_spec import STANDARD_GRAVITY

# Middle and spread of the logarithms: density [kg/m²], rates [1/s] and limits of the
# wheel (rolling, lateral), rate of the floor, and coefficient of dry friction. Wide
# enough for a friction to be next to nothing, purely viscous, or to hold a body fast.
_LOG_MIDDLE = np.log([30.0, 0.3, 5.0, 3.0, 3.0, 1.0, 0.1])
_LOG_SPREAD = np.array([1.5, 2.5, 2.5, 2.0, 2.0, 2.5, 2.0])
_NUM_LOGS = len(_LOG_MIDDLE)
_NUM_PLAIN = _NUM_LOGS + 3


class PhysicsNumbers(eqx.Module):
    """From coordinates to params."""

    scene: Scene
    moving: tuple[int, ...] = eqx.field(static=True)
    """Which bodies are not static."""
    has_pin: bool = eqx.field(static=True)
    friction: float | None = eqx.field(static=True)
    """Contact friction of every body; None: there is no contact."""
    restitution: float = eqx.field(static=True)

    @property
    def dim(self) -> int:
        """Coordinates of each body."""
        return _NUM_PLAIN + 3 * self.has_pin

    def params(
        self, z: Float[Array, "moving dim"], mean_pose: Float[Array, "moving 4"]
    ) -> Params:
        """What coordinates stand for.

        Args:
            z: coordinates of each body; zero is the middle of the prior.
            mean_pose: means of x, y [m], cos θ and sin θ over what was seen.

        Returns:
            The params.
        """
        index, scene = np.array(self.moving), self.scene
        num = scene.num_bodies
        empty = empty_params(
            num,
            num_revolute=len(index) if self.has_pin else 0,
            num_wheel=1,
            num_ground=1,
            friction=self.friction,
            restitution=self.restitution,
        )
        middle = jnp.asarray(_LOG_MIDDLE, z.dtype)[None]
        spread = jnp.asarray(_LOG_SPREAD, z.dtype)[None]
        # Bounded, or a search that runs away meets infinities.
        logs = jnp.clip(z[:, :_NUM_LOGS], -6.0, 6.0)
        value = jnp.exp(middle + spread * logs)
        mass = value[:, 0] * scene.area[index]
        reach = _reach(scene)[index]
        place = reach[:, None] * jnp.sin(z[:, _NUM_LOGS : _NUM_LOGS + 2])
        heading = 0.5 * jnp.pi * z[:, _NUM_LOGS + 2]
        rates = mass[:, None] * value[:, 1:3]
        limits = STANDARD_GRAVITY * mass[:, None] * value[:, 3:5]

        def put(column: Array, values: Array) -> Array:
            return column.at[index].set(values.astype(column.dtype))

        is_moving = jnp.zeros((num, 1), bool).at[index].set(True)
        params = dataclasses.replace(
            empty,
            density=put(empty.density, value[:, 0]),
            wheel=dataclasses.replace(
                empty.wheel,
                active=is_moving,
                position=put(empty.wheel.position, place[:, None]),
                heading=put(empty.wheel.heading, heading[:, None]),
                viscous=put(empty.wheel.viscous, rates[:, None]),
                dry=put(empty.wheel.dry, limits[:, None]),
            ),
            ground=dataclasses.replace(
                empty.ground,
                active=is_moving,
                dry=put(empty.ground.dry, value[:, 6:7]),
                viscous=put(empty.ground.viscous, (mass * value[:, 5])[:, None]),
            ),
        )
        if not self.has_pin:
            return params
        return dataclasses.replace(params, revolute=self._pins(z, mean_pose, reach))

    def _pins(
        self,
        z: Float[Array, "moving dim"],
        mean_pose: Float[Array, "moving 4"],
        reach: Float[Array, " moving"],
    ) -> Revolute:
        """One of each body to the world."""
        anchor = reach[:, None] * jnp.sin(z[:, _NUM_PLAIN : _NUM_PLAIN + 2])
        cos, sin = mean_pose[:, 2], mean_pose[:, 3]
        x, y = anchor[:, 0], anchor[:, 1]
        turned = jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
        num = len(self.moving)
        return Revolute(
            active=z[:, -1] > 0,
            body_a=jnp.asarray(np.array(self.moving, np.int32)),
            body_b=jnp.full(num, WORLD, jnp.int32),
            anchor_a=anchor,
            anchor_b=mean_pose[:, :2] + turned,
            viscous=jnp.zeros(num, z.dtype),
            dry=jnp.full(num, jnp.inf, z.dtype),
        )


def _reach(scene: Scene) -> Float[Array, " body"]:
    """Largest distance of an outline from its centre of mass [m]."""
    square = jnp.sum(scene.vertices**2, axis=-1)
    far = jnp.max(jnp.where(scene.vertex_mask, square, 0.0), axis=-1)
    return jnp.maximum(jnp.sqrt(jax.lax.stop_gradient(far)), scene.radius)
