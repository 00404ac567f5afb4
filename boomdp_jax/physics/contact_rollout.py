"""Steps of worlds with contact, many at a time, with the batch as the last axis."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.lanes import in_lanes
from boomdp_jax.physics.contact_coupling import coupled_substep, is_coupled
from boomdp_jax.physics.contact_rows import Ease
from boomdp_jax.physics.contact_step import (
    NUM_POINTS,
    Impulses,
    contact_substep,
    find_contacts,
)
from boomdp_jax.physics.contact_world import ContactWorld, contact_world
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.prepare import Prepared, prepare
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State
from boomdp_jax.physics.step_info import StepInfo, report
from boomdp_jax.physics.tournament import num_rounds, num_seats


def contact_step(
    scene: Scene,
    params: Params,
    state: State,
    wrench: Float[Array, "body 3"],
    length: Float[Array, ""],
    cache: Float[Array, "round pair 4"] | None,
) -> tuple[State, StepInfo]:
    """Advance a world with contact by one step; the arguments are those of `step`."""
    _check(params)
    out, impulses = in_lanes(
        _rollout, scene, params, state, wrench[None], length, cache
    )
    pose, twist, *reported = (leaf[0] for leaf in out)
    return State(pose, twist), StepInfo(*reported, cache=impulses)


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


def contact_rollout(
    scene: Scene,
    params: Params,
    state: State,
    wrenches: Float[Array, "time body 3"],
    length: Float[Array, "*time"],
) -> tuple[State, StepInfo]:
    """Advance a world with contact by many steps, given what `rollout` is given."""
    _check(params)
    out, _ = in_lanes(_rollout, scene, params, state, wrenches, length, None)
    return State(*out[:2]), StepInfo(*out[2:])


def _check(params: Params) -> None:
    if params.surface is None:
        raise ValueError(
            "scene has contact: expected params with a surface (friction and "
            "restitution of every body), got None"
        )


def _rollout(
    scene: Scene, params: Params, state: State, wrenches: Any, length: Any, cache: Any
) -> tuple[tuple, Any]:
    """Fields of the states and of the reports, and the impulses at the end."""
    num_bodies = state.pose.shape[0]
    motion = Motion(*(state.pose[:, i] for i in range(3)), *_columns(state.twist))
    impulses = _impulses(cache, num_bodies, motion.x)
    first = length if length.ndim == 1 else length[0]
    prepared = _prepared(scene, params, first)
    world = contact_world(scene, params, prepared)

    def advance(carry, inputs):
        motion, impulses = carry
        wrench, step_length = inputs
        now = prepared
        if step_length is not None:
            now = _prepared(scene, params, step_length)
        motion, impulses, overlap = _step(
            scene, world, now, motion, _columns(wrench), impulses
        )
        info = jax.vmap(report, in_axes=-1, out_axes=-1)(now, motion)
        pose, twist = jnp.stack(motion[:3], axis=1), jnp.stack(motion[3:], axis=1)
        overflow = jnp.zeros_like(info.is_finite)
        out = (pose, twist, info.constraint_error, info.is_finite, overlap, overflow)
        return (motion, impulses), out

    inputs = (wrenches, None if length.ndim == 1 else length)
    step = jax.checkpoint(advance, prevent_cse=False)
    (_, impulses), out = jax.lax.scan(step, (motion, impulses), inputs)
    return out, _packed(impulses)


def _prepared(scene: Scene, params: Params, length) -> Prepared:
    prepared = jax.vmap(prepare, in_axes=-1, out_axes=-1)(scene, params, length)
    assert isinstance(prepared, Prepared)
    return prepared


def _step(
    scene: Scene,
    world: ContactWorld,
    prepared: Prepared,
    motion: Motion,
    force: tuple,
    impulses: Impulses,
) -> tuple[Motion, Impulses, Any]:
    """All substeps of one step."""
    mobile, length = prepared.mobile, prepared.length
    motion = motion._replace(
        vx=mobile * motion.vx, vy=mobile * motion.vy, spin=mobile * motion.spin
    )
    contacts, touch = find_contacts(world, motion, impulses)
    light = mobile / prepared.mass
    ease = Ease(light, light, mobile / prepared.inertia)
    gain = (
        light * (length[None] * force[0] + prepared.weight[0]),
        light * (length[None] * force[1] + prepared.weight[1]),
        ease.spin * length[None] * force[2],
    )
    start = motion

    def advance(carry, _):
        motion, touch = carry
        free = tuple(v + dv for v, dv in zip(motion[3:], gain, strict=True))
        moved = tuple(p - q for p, q in zip(motion[:3], start[:3], strict=True))
        if is_coupled(prepared):
            motion, touch = coupled_substep(
                contacts, prepared, motion, moved, force, touch, scene.num_sweeps
            )
            return (motion, touch), None
        motion, touch = contact_substep(
            contacts,
            world.eases,
            ease,
            length,
            motion,
            moved,
            free,
            touch,
            scene.num_sweeps,
        )
        return (motion, touch), None

    (motion, touch), _ = jax.lax.scan(
        advance, (motion, touch), None, length=scene.num_substeps
    )
    return motion, touch.impulses, contacts.overlap


def _columns(array: Any) -> tuple:
    """Of `[body, number, lane]`, one array for each number."""
    return tuple(array[:, i] for i in range(array.shape[1]))


def _impulses(cache: Any, num_bodies: int, like: Any) -> Impulses:
    """Impulses of every round's pairs, from an array `[round, pair, 4, lane]`."""
    num = num_seats(num_bodies) // 2
    rounds = range(num_rounds(num_bodies))
    if cache is None:
        zero = jnp.zeros((num, like.shape[-1]), like.dtype)
        return [[(zero, zero)] * NUM_POINTS for _ in rounds]
    return [
        [(cache[r, :, 2 * p], cache[r, :, 2 * p + 1]) for p in range(NUM_POINTS)]
        for r in rounds
    ]


def _packed(impulses: Impulses) -> Any:
    return jnp.stack(
        [
            jnp.stack([number for point in points for number in point], axis=1)
            for points in impulses
        ]
    )
