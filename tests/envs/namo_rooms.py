"""Two chambers with a door between them, and one thing; all rooms are one program."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.envs import Room, Thing, room_scene
from boomdp_jax.envs.namo_room import room_params
from boomdp_jax.physics import Params

DOOR = (3.1, 2.0)
"""Middle of the door, which is 1 m wide and goes through a wall of 0.2 m."""
START, GOAL = (1.0, 2.0), (5.0, 3.1)
_WALLS = (
    (-0.2, 0.0, 0.0, 4.0),
    (-0.2, -0.2, 6.2, 0.0),
    (6.0, 0.0, 6.2, 4.0),
    (-0.2, 4.0, 6.2, 4.2),
    (3.0, 0.0, 3.2, 1.5),
    (3.0, 2.5, 3.2, 4.0),
)


def thing(**changes) -> Thing:
    """A light box in a corner, out of the way."""
    box = Thing(
        name="box",
        label="chair",
        outline=(0.3, 0.25),
        pose=(5.5, 0.5, 0.0),
        kind="free",
        density=40.0,
        friction=0.3,
    )
    return box._replace(**changes)


def room(one: Thing | None = None, **changes) -> Room:
    """The chambers, with the box unless another thing is given."""
    things = (thing() if one is None else one,)
    return Room(things, _WALLS, START, GOAL)._replace(**changes)


def poses_of(one: Room) -> np.ndarray:
    """Where its things are."""
    return np.array([thing.pose for thing in one.things])


def lone_params(one: Thing, num: int = 1) -> Params:
    """What is true of a thing alone in its room, as so many equal hypotheses."""
    alone = room(one)
    whole = room_params(alone, room_scene(alone))
    first = jax.tree.map(
        lambda leaf: jnp.repeat(leaf[None, :1], num, axis=0),
        (whole.density, whole.revolute, whole.distance, whole.wheel, whole.ground),
    )
    density, revolute, distance, wheel, ground = first
    # Law-shape nuisances, as in draws of a posterior, so that these are one program.
    none = jnp.zeros_like(ground.dry)
    return Params(
        density,
        revolute,
        distance,
        dataclasses.replace(wheel, half_track=none),
        dataclasses.replace(
            ground, torque_share=none, load_shift=jnp.zeros_like(wheel.position)
        ),
    )
