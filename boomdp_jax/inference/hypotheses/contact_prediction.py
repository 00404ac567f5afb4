r"""One step of a block whose bodies may collide, cut where they first do.

The engine finds the direction of contacts at the start of a step, and lets bodies that
meet stay together until the end of the substep. A disc that is struck off its centre at
1 m/s then flies off by centimetres a second wrong, whatever the number of substeps, and
what a step says of its start is a sawtooth. So the instant at which outlines first
touch is found beforehand (`first_touch.py`), along the motion that bodies have without
contact, and a step is taken in three parts: until just before it, a short one over it,
and the rest; pairs that approach do not collide in a part in which they do not touch.
Impacts that follow another one within a step are no better than the engine's.

Whether bodies have collided by the end of a step may depend on a hair's breadth, where
they go afterwards does not. A filter that compares where neighbours of its estimate go
would find that it knows nothing of the twists after such a step; so it asks whether the
estimate itself collides, and treats the neighbours alike (`first_impact`).

Walls are bodies of the engine's scene, but not of the state: nothing reads where they
are.

All of this costs some ten times what a step without contact does, and in most rows of
most recordings nothing is near anything else: in those (`touching`) bodies go on as if
there were no contact.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.inference.hypotheses.first_touch import NEVER, PairSort, touch_times
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State, state_from_array
from boomdp_jax.physics.step import step

NUM_SUBSTEPS = 2
"""Equal parts of each part of a step."""

# The middle part reaches so far before and after the first touch, and no part is
# shorter than half of that, as shares of the step. Bodies stay together in it that
# bounce: at 1 m/s and 20 ms by 0.04 mm.
_REACH = 0.002
_EDGE = 1.5 * _REACH
# How far from the middle of a step an impact may be to be taken back and forth to, as a
# share of the step: half of one before it begins or after it ends.
_MOST_SHIFT = 1.0


class ContactScene(eqx.Module):
    """A block's bodies and the walls near them, as the engine takes them."""

    scene: Scene
    """Bodies of the block, then walls, with outlines."""
    wall_pose: Float[Array, "wall 3"]
    """Where the walls are [m, m, rad]."""
    sorts: tuple[PairSort, ...] = eqx.field(static=True)
    """Which may touch."""
    apart: Scene
    """Bodies of the block alone, without outlines: where nothing can touch."""

    @property
    def num_walls(self) -> int:
        """How many of the scene's bodies are walls."""
        return self.wall_pose.shape[0]


def predict_step(
    world: Scene | ContactScene,
    params: Params,
    state: Float[Array, "body 6"],
    action: Float[Array, "body 3"],
    length: FloatScalar,
) -> Float[Array, "body 6"]:
    """Where a step of a block ends, in a scene with contact or without.

    Args:
        world: the block's bodies.
        params: of the block.
        state: channels of its bodies.
        action: wrenches on them, world frame [N, N, N m].
        length: of the step [s].

    Returns:
        Their channels after it.
    """
    if isinstance(world, ContactScene):
        return contact_step(world, params, state, action, length)
    return step(world, params, state_from_array(state), action, dt=length)[0].array


def contact_step(
    world: ContactScene,
    params: Params,
    state: Float[Array, "body 6"],
    action: Float[Array, "body 3"],
    length: FloatScalar,
    impact: Bool[Array, "all all"] | None = None,
) -> Float[Array, "body 6"]:
    """Where a step ends.

    Args:
        world: bodies and walls.
        params: of the block; its surface has the walls', too.
        state: channels of the block's bodies.
        action: wrenches on them, world frame [N, N, N m].
        length: of the step [s].
        impact: which pair of bodies and walls collides first, whether that is within
            the step or a little before or after; see `first_impact`, which is the
            default.

    Returns:
        Their channels after it.
    """
    begin = _begin(world, params, state, action, length)
    scene, params, pose, twist, wrench, gain = begin
    times = _times(world, pose, twist, gain)
    if impact is None:
        impact = _impact(times, length)
    has_impact = jnp.any(impact)
    first = jnp.min(jnp.where(impact, times, NEVER))
    # A pair that no more than grazes may miss.
    first = jnp.where(jnp.abs(first / length - 0.5) < _MOST_SHIFT, first, 0.5 * length)
    cut = jnp.clip(first / length, _EDGE, 1.0 - _EDGE)
    shift = jnp.where(has_impact, first - cut * length, 0.0)
    # Pairs that approach are left alone until then.
    is_lying = (times <= _EDGE * length) & ~impact | (times == NEVER)
    is_due = (times <= (cut + _REACH) * length) & has_impact
    shares = jnp.stack(
        [cut - _REACH, jnp.full_like(cut, 2.0 * _REACH), 1.0 - cut - _REACH]
    )
    masks = jnp.stack([is_lying, is_lying | is_due | impact, is_lying])

    def part(now: State, inputs: tuple) -> tuple[State, None]:
        share, mask, is_rest = inputs
        own, times = share * length, _times(world, now.pose, now.twist, gain)
        is_next = (times <= own) & has_impact
        is_last = (times <= _EDGE * length) | is_next | (times == NEVER)
        mask = jnp.where(is_rest, is_last, mask)
        here = eqx.tree_at(lambda s: s.collides, scene, scene.collides & mask)
        return step(here, params, now, wrench, dt=own)[0], None

    # As a loop: a step takes long to compile.
    # Of walls among the state's bodies a filter may try twists, too.
    shift = jnp.where(scene.is_static[:, None], 0.0, shift)
    now = State(pose + shift * twist, twist)
    inputs = (shares, masks, jnp.array([False, False, True]))
    now, _ = jax.lax.scan(part, now, inputs)
    now = State(now.pose - shift * now.twist, now.twist)
    return now.array[: state.shape[0]]


def first_impact(
    world: ContactScene,
    params: Params,
    state: Float[Array, "body 6"],
    action: Float[Array, "body 3"],
    length: FloatScalar,
) -> Bool[Array, "all all"]:
    """Which pair of bodies and walls collides first within a step.

    Given it, `contact_step` is smooth in the state: neighbours that collide a little
    before the step are taken back and forth to when they do, and so are those that
    collide a little after it. Neighbours of a state that does not collide do not.

    Args:
        world: bodies and walls.
        params: of the block.
        state: channels of the block's bodies.
        action: wrenches on them, world frame [N, N, N m].
        length: of the step [s].

    Returns:
        The pair, symmetric; none where nothing collides.
    """
    begin = _begin(world, params, state, action, length)
    return _impact(_times(world, *begin[2:4], begin[5]), length)


def _impact(times: Float[Array, "all all"], length) -> Bool[Array, "all all"]:
    return (times == jnp.min(times)) & (times < length)


def _begin(world: ContactScene, params: Params, state, action, length) -> tuple:
    """Scene, params, pose, twist, wrench, acceleration of all bodies and walls."""
    num_walls = world.num_walls
    scene, params = world.scene, _with_walls(params, num_walls)
    pose = jnp.concatenate([state[:, :3], world.wall_pose.astype(state.dtype)])
    twist = jnp.pad(state[:, 3:], ((0, num_walls), (0, 0)))
    wrench = jnp.pad(action, ((0, num_walls), (0, 0)))
    return scene, params, pose, twist, wrench, _acceleration(scene, params, wrench)


def _times(world: ContactScene, pose, twist, gain) -> Float[Array, "all all"]:
    """When pairs touch if nothing but forces and gravity acts."""
    mobile = jnp.where(world.scene.is_static[:, None], 0.0, 1.0)
    return touch_times(world.scene, pose, mobile * twist, mobile * gain, world.sorts)


def _acceleration(
    scene: Scene, params: Params, wrench: Float[Array, "body 3"]
) -> Float[Array, "body 3"]:
    """By forces and gravity alone."""
    mass = params.density * scene.area
    inertia = jnp.stack([mass, mass, mass * scene.gyration], axis=-1)
    return wrench / inertia + jnp.pad(scene.gravity, (0, 1))[None]


def _with_walls(params: Params, num_walls: int) -> Params:
    """Params of a block with those of walls, which have no numbers but a surface."""

    def pad(leaf: Array, value: float = 0.0) -> Array:
        width = [(0, num_walls)] + [(0, 0)] * (leaf.ndim - 1)
        return jnp.pad(leaf, width, constant_values=np.asarray(value, leaf.dtype))

    return eqx.tree_at(
        lambda p: (p.density, p.wheel, p.ground),
        params,
        (
            pad(params.density, 1.0),
            jax.tree.map(pad, params.wheel),
            jax.tree.map(pad, params.ground),
        ),
    )
