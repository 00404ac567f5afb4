"""Steps of worlds of any kind, many at a time, with the batch as the last axis."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.lanes import BLOCK, in_lanes
from boomdp_jax.core.unmerged import unmerged
from boomdp_jax.physics.contact_coupling import coupled_substep, is_coupled
from boomdp_jax.physics.contact_rows import Ease
from boomdp_jax.physics.contact_step import (
    NUM_POINTS,
    Impulses,
    contact_substep,
    find_contacts,
)
from boomdp_jax.physics.contact_world import ContactWorld, contact_world
from boomdp_jax.physics.general_step import general_substep
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.prepare import Prepared, prepare_world
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State
from boomdp_jax.physics.step_info import StepInfo, report
from boomdp_jax.physics.tournament import as_rounds, num_rounds, num_seats, stacked

# Bodies without contact that are worked on together. Their arrays are small: a substep
# of a pair with nine rows takes 5.9 us 104 at a time, 4.7 us 416 at a time and 7.0 us
# 840 at a time.
_BODIES_IN_BLOCK = 840


class World(NamedTuple):
    """What depends on scene, params and step length alone."""

    prepared: Prepared
    contact: ContactWorld | None
    """None in a scene without contact."""


def prepare_step_of_world(
    scene: Scene, params: Params, length: Float[Array, ""]
) -> World:
    """Work out all that does not depend on the state.

    Args:
        scene: outlines, feet, gravity.
        params: one hypothesis.
        length: of a step [s].

    Returns:
        What `world_step` takes.

    Raises:
        ValueError: the scene has contact, and the params do not say what it is like.
    """
    _check(scene, params)
    return in_lanes(_world, scene, params, length, block=_block(scene))


def world_step(
    scene: Scene, world: World, state: State, wrench: Float[Array, "body 3"], cache: Any
) -> tuple[State, StepInfo]:
    """Advance a world by one step; the arguments are those of `step`."""
    sizes = (scene.num_substeps, scene.num_sweeps)
    arguments = world, state, wrench[None], cache
    out, impulses = in_lanes(_rollout_of, *arguments, static=sizes, block=_block(scene))
    pose, twist, *reported, push = jax.tree.map(lambda leaf: leaf[0], out)
    info = StepInfo(*reported, cache=impulses, contact_wrench=push)
    return State(pose, twist), info


def empty_cache(scene: Scene) -> Float[Array, "round pair 4"] | None:
    """What `step` takes as `cache` where no step came before, in the form of others.

    Args:
        scene: outlines.

    Returns:
        Impulses of nothing; None for a scene without contact.
    """
    if scene.collides is None:
        return None
    num = scene.num_bodies
    shape = (num_rounds(num), num_seats(num) // 2, 2 * NUM_POINTS)
    return jnp.zeros(shape, scene.area.dtype)


def world_rollout(
    scene: Scene,
    params: Params,
    state: State,
    wrenches: Float[Array, "time body 3"],
    length: Float[Array, "*time"],
) -> tuple[State, StepInfo]:
    """Advance a world by many steps, given what `rollout` is given."""
    _check(scene, params)
    arguments = scene, params, state, wrenches, length
    out, _ = in_lanes(_rollout, *arguments, block=_block(scene))
    pose, twist, *reported, push = out
    return State(pose, twist), StepInfo(*reported, contact_wrench=push)


def _block(scene: Scene) -> int:
    """Lanes that are worked on together on a CPU."""
    if scene.collides is not None:
        return BLOCK
    return max(BLOCK, _BODIES_IN_BLOCK // scene.num_bodies)


def _check(scene: Scene, params: Params) -> None:
    if scene.collides is not None and params.surface is None:
        raise ValueError(
            "scene has contact: expected params with a surface (friction and "
            "restitution of every body), got None"
        )


def _world(scene: Scene, params: Params, length: Any) -> World:
    prepared = prepare_world(scene, params, length)
    contact = None
    if scene.collides is not None:
        contact = contact_world(scene, params, prepared)
    return World(prepared, contact)


def _rollout(
    scene: Scene, params: Params, state: State, wrenches: Any, length: Any
) -> tuple[tuple, Any]:
    """Fields of states and reports, wrenches of contact, and impulses at the end."""
    sizes = (scene.num_substeps, scene.num_sweeps)
    if length.ndim == 1:
        world = _world(scene, params, length)
        return _rollout_of(*sizes, world, state, wrenches, None)
    contact = _world(scene, params, length[0]).contact
    start = _start(state, None, contact)

    def advance(carry, inputs):
        wrench, step_length = inputs
        world = World(prepare_world(scene, params, step_length), contact)
        return _advance(sizes, world, carry, wrench)

    return _scanned(advance, start, (wrenches, length))


def _rollout_of(
    num_substeps: int, num_sweeps: int, world: World, state: State, wrenches, cache
) -> tuple[tuple, Any]:
    """The same with one length for all steps."""
    start = _start(state, cache, world.contact)

    def advance(carry, wrench):
        return _advance((num_substeps, num_sweeps), world, carry, wrench)

    return _scanned(advance, start, wrenches)


def _start(state: State, cache: Any, contact: ContactWorld | None) -> tuple:
    motion = Motion(*(state.pose[:, i] for i in range(3)), *_columns(state.twist))
    impulses = None
    if contact is not None:
        impulses = _impulses(cache, motion.x.shape[0], motion.x)
    return motion, impulses


def _scanned(advance, start: tuple, inputs: Any) -> tuple[tuple, Any]:
    """Step after step; a reverse pass takes each again from the state before it."""
    step = jax.checkpoint(advance, prevent_cse=False)
    (_, impulses), out = jax.lax.scan(step, start, inputs)
    return out, None if impulses is None else _packed(impulses)


def _advance(sizes: tuple, world: World, carry: tuple, wrench: Any) -> tuple:
    """One step, and what it reports."""
    motion, impulses = carry
    motion, impulses, overlap, push = _step(
        sizes, world, motion, _columns(wrench), impulses
    )
    error, is_finite = report(world.prepared, motion)
    pose, twist = jnp.stack(motion[:3], axis=1), jnp.stack(motion[3:], axis=1)
    overflow = None if overlap is None else jnp.zeros_like(is_finite)
    out = (pose, twist, error, is_finite, overlap, overflow, push)
    return (motion, impulses), out


def _step(
    sizes: tuple, world: World, motion: Motion, force: tuple, impulses: Any
) -> tuple[Motion, Impulses | None, Any, Any]:
    """All substeps of one step: also deepest overlap, and mean wrenches of contact."""
    num_substeps, num_sweeps = sizes
    prepared, contact = world
    mobile, length = prepared.mobile, prepared.length
    motion = motion._replace(
        vx=mobile * motion.vx, vy=mobile * motion.vy, spin=mobile * motion.spin
    )
    if contact is None:

        def alone(motion, _):
            motion = motion._replace(x=unmerged(motion.x))
            return general_substep(prepared, motion, force), None

        motion, _ = _repeated(alone, motion, num_substeps)
        return motion, None, None, None
    light = mobile / prepared.mass
    ease = Ease(light, light, mobile / prepared.inertia)
    gain = (
        light * (length[None] * force[0] + prepared.weight[0]),
        light * (length[None] * force[1] + prepared.weight[1]),
        ease.spin * length[None] * force[2],
    )
    # Only whether something is an impact depends on it.
    forced = jax.lax.stop_gradient(gain)
    contacts, touch = find_contacts(contact, motion, forced, impulses)
    start = motion

    def advance(carry, _):
        motion, touch = carry
        motion = motion._replace(x=unmerged(motion.x))
        free = tuple(v + dv for v, dv in zip(motion[3:], gain, strict=True))
        x, y, angle = (p - q for p, q in zip(motion[:3], start[:3], strict=True))
        moved = x, y, contact.turns * angle
        if is_coupled(prepared):
            carry = coupled_substep(
                contacts, prepared, motion, moved, force, touch, num_sweeps
            )
            return carry, carry[1].sums
        carry = contact_substep(
            contacts,
            contact.eases,
            ease,
            length,
            motion,
            moved,
            free,
            touch,
            num_sweeps,
        )
        return carry, carry[1].sums

    (motion, touch), sums = _repeated(advance, (motion, touch), num_substeps)
    # Each substep's impulses, over the length of the whole step.
    whole = num_substeps * length[None]
    push = jnp.stack([jnp.sum(part, axis=0) / whole for part in sums], axis=1)
    return motion, touch.impulses, contacts.overlap, push


def _repeated(advance, start: Any, num: int) -> tuple:
    """Substep after substep; a reverse pass takes each again from what came before.

    What one substep needs to be gone back through stays in the caches; with that of
    all substeps a reverse pass takes twice the time.
    """
    substep = jax.checkpoint(advance, prevent_cse=False)
    return jax.lax.scan(substep, start, None, length=num)


def _columns(array: Any) -> tuple:
    """Of `[body, number, lane]`, one array for each number."""
    return tuple(array[:, i] for i in range(array.shape[1]))


def _impulses(cache: Any, num_bodies: int, like: Any) -> Impulses:
    """Impulses of every round's pairs, from an array `[round, pair, 4, lane]`."""
    if cache is None:
        num, lanes = num_seats(num_bodies) // 2, like.shape[-1]
        shape = (num_rounds(num_bodies), num, 2 * NUM_POINTS, lanes)
        cache = jnp.zeros(shape, like.dtype)
    points = [(cache[:, :, 2 * p], cache[:, :, 2 * p + 1]) for p in range(NUM_POINTS)]
    return as_rounds(points, num_bodies)


def _packed(impulses: Impulses) -> Any:
    points = stacked(impulses)
    return jnp.stack([number for point in points for number in point], axis=2)
