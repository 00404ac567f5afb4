"""How the robot drives: along a way while it holds nothing, or with a steady push.

One compiled function does either, several steps of the world at a time, so that an
episode is a few hundred calls of one program.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, Key, on_device
from boomdp_jax.envs.namo import NamoReading, NamoState, NamoWorld, namo_step

NUM_STEPS = 4
"""Of the world in one call, and of a push."""
MOST_POINTS = 128
"""Of a way."""
_AHEAD = 0.3
"""How far ahead on its way the robot looks [m]."""
_SLOWING = 2.0
"""Speed over distance from the end [1/s]."""


class Command(eqx.Module):
    """What to do for `NUM_STEPS` steps."""

    is_push: BoolScalar
    push: Float[Array, "3"]
    """Wrench with which it drives, if it is a push [N, N, N m]."""
    way: Float[Array, "point 2"]
    """Else, where to go [m]; the last point is repeated."""
    speed: FloatScalar
    """[m/s]"""


class Driven(NamedTuple):
    """What became of a command; leading axis `step`."""

    reading: NamoReading
    place: Float[Array, "step body 3"]
    """True poses, for pictures and for scores [m, m, rad]."""
    effort: FloatScalar
    """Mean force over the greatest, times the duration [s]."""
    has_slipped: BoolScalar
    force: FloatScalar
    """Greatest that the grasp transmitted [N]."""
    overlap: FloatScalar
    """Deepest [m]."""


def pushing(wrench: Float[Array | np.ndarray, "3"]) -> Command:
    """Drive with one wrench."""
    return Command(
        is_push=on_device(True, bool),
        push=on_device(wrench),
        way=on_device(np.zeros((MOST_POINTS, 2))),
        speed=on_device(0.0),
    )


def going(way: Float[np.ndarray, "point 2"], speed: float) -> Command:
    """Go along a way.

    Args:
        way: its points [m]; of more than `MOST_POINTS`, the first ones.
        speed: at most [m/s].

    Raises:
        ValueError: no point.
    """
    way = np.asarray(way, float)
    if not len(way):
        raise ValueError("way: expected one point at least, got none")
    way = way[:MOST_POINTS]
    padded = np.concatenate([way, np.repeat(way[-1:], MOST_POINTS - len(way), axis=0)])
    # Of the same types as pushes, so that there is one program.
    return Command(
        is_push=on_device(False, bool),
        push=on_device(np.zeros(3)),
        way=on_device(padded),
        speed=on_device(speed),
    )


@jax.jit
def drive(
    key: Key, world: NamoWorld, state: NamoState, command: Command
) -> tuple[NamoState, Driven]:
    """Carry a command out, for `NUM_STEPS` steps.

    Args:
        key: of the sensors' noise.
        world: the room.
        state: now.
        command: what to do.

    Returns:
        The state, and what became of it.
    """

    def advance(state: NamoState, key: Key) -> tuple[NamoState, tuple]:
        towards = _towards(world, state, command)
        wrench = jnp.where(command.is_push, command.push, towards)
        state, reading, info = namo_step(key, world, state, wrench)
        size = jnp.sqrt(jnp.sum(wrench[:2] ** 2))
        effort = world.scene.dt * jnp.minimum(size / world.most[0], 1.0)
        told = (reading, state.physics.pose, effort)
        return state, (*told, info.has_slipped, info.force, info.overlap)

    keys = jax.random.split(key, NUM_STEPS)
    state, (reading, place, effort, slipped, force, overlap) = jax.lax.scan(
        advance, state, keys
    )
    return state, Driven(
        reading=reading,
        place=place,
        effort=jnp.sum(effort),
        has_slipped=jnp.any(slipped),
        force=jnp.max(force),
        overlap=jnp.max(overlap),
    )


def _towards(world: NamoWorld, state: NamoState, command: Command) -> Float[Array, "3"]:
    """Force that brings the robot to the speed at which it should go."""
    robot, scene = world.robot, world.scene
    pose, twist = state.physics.pose[robot], state.physics.twist[robot]
    way = command.way.astype(pose.dtype)
    away = jnp.sqrt(jnp.sum((way - pose[None, :2]) ** 2, axis=-1))
    nearest = jnp.argmin(away)
    # As far on as is within reach without losing the way.
    index: Int[Array, " point"] = jnp.arange(way.shape[0])
    is_near: Bool[Array, " point"] = (index >= nearest) & (away < _AHEAD)
    target = way[jnp.maximum(jnp.max(jnp.where(is_near, index, 0)), nearest)]
    aim = target - pose[:2]
    distance = jnp.sqrt(jnp.sum(aim**2) + 1e-12)
    speed = jnp.minimum(command.speed.astype(pose.dtype), _SLOWING * away[-1])
    wanted = aim / distance * jnp.minimum(speed, 4.0 * distance)
    mass = world.physics.density[robot] * scene.area[robot]
    inertia = mass * scene.gyration[robot]
    force = 0.7 * mass / scene.dt * (wanted - twist[:2])
    return jnp.concatenate([force, (-0.7 * inertia / scene.dt * twist[2])[None]])
