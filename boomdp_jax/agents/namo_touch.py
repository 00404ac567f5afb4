"""Whether a thing that is held is pressed against something else.

What is felt at the wrist is then not what holds the thing itself: a light box behind
which another one stands feels as heavy as both.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import BoolScalar, IntScalar
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.separation import pair_separation
from boomdp_jax.physics.state import State

# As far as this along the push nothing else may be [m]: some steps' way, and more than
# the noise of readings.
_NEAR = 0.02


def is_pressed(
    scene: Scene,
    state: State,
    thing: IntScalar | int,
    robot: IntScalar | int,
    push: Float[Array, "2"],
) -> BoolScalar:
    """Whether a push presses a thing against another body.

    Args:
        scene: outlines of all bodies.
        state: where they are read to be.
        thing: index of the body that is pushed.
        robot: index of the body that pushes, which does not count.
        push: force on the thing [N].

    Returns:
        Whether the thing would overlap another body a little farther along the push,
        and more than it does now. Sliding along a wall and leaving one do not count.
    """
    size = jnp.sqrt(jnp.sum(push**2))
    way = _NEAR * push / jnp.where(size > 0, size, 1.0)
    moved = state.pose.at[thing, :2].add(way)
    others = jnp.arange(scene.num_bodies)

    def gaps(pose: Float[Array, "body 3"]) -> Float[Array, " body"]:
        where = State(pose, state.twist)
        return jax.vmap(lambda j: pair_separation(scene, where, thing, j))(others)

    now, then = gaps(state.pose), gaps(moved)
    counts = (others != thing) & (others != robot)
    return jnp.any(counts & (then < 0.0) & (then < now - 0.5 * _NEAR))


@jax.jit
def pressed_steps(
    scene: Scene,
    before: State,
    after: State,
    thing: IntScalar,
    robot: IntScalar,
    push: Float[Array, "step 2"],
) -> Bool[Array, " step"]:
    """The same of steps, at their beginning or at their end.

    Args:
        scene: outlines of all bodies.
        before: readings before each step, leading axis `step`.
        after: readings after it.
        thing: index of the body that is pushed.
        robot: index of the body that pushes.
        push: force on the thing [N].
    """

    def one(before: State, after: State, push: Float[Array, "2"]) -> BoolScalar:
        first = is_pressed(scene, before, thing, robot, push)
        return first | is_pressed(scene, after, thing, robot, push)

    return jax.vmap(one)(before, after, push)
