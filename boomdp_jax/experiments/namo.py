"""Robots among furniture by name: what each believes of it, and what it does about it.

`true` knows what all things are; `physics` learns, shares what it learnt between things
that look alike, and makes test pushes where they pay; `physics-map` plans on the most
probable hypothesis alone and makes none. The others do not learn: `prior` plans on the
prior, `optimistic` takes everything to be free and of usual weight, `lightest` moves
what looks lightest, `navigation` moves nothing.
"""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.agents.namo_agent import Character
from boomdp_jax.agents.namo_episode import NamoRecord, run_namo
from boomdp_jax.core.arrays import Key, on_device
from boomdp_jax.envs.namo_room import LOOKS, Room, room_params, room_scene
from boomdp_jax.envs.namo_rooms import random_room, story_room
from boomdp_jax.models.room_belief import FixedRoom, LearntRoom, RoomBelief
from boomdp_jax.physics.params import Params, empty_params

CHARACTERS: Mapping[str, Character] = MappingProxyType(
    {
        one.name: one
        for one in (
            Character("true", learns=False),
            Character("physics", learns=True, has_tests=True),
            Character("physics-map", learns=True),
            Character("prior", learns=False),
            Character("optimistic", learns=False),
            Character("lightest", learns=False, picks_lightest=True),
            Character("navigation", learns=False, moves_things=False),
        )
    }
)
"""Agents by their names."""
_USUAL_FRICTION = 0.3
_IMMOVABLE = 1e6
"""Density that stands for what is fixed [kg/m²]."""


def make_room(name: str, seed: int, num_things: int, difficulty: float) -> Room:
    """A room by the name of its kind.

    Args:
        name: `story` or `random`.
        seed: which.
        num_things: in a random room.
        difficulty: of a random room.

    Raises:
        ValueError: no such kind of room, or what `random_room` refuses.
    """
    if name == "story":
        return story_room(seed)
    if name == "random":
        return random_room(seed, num_things, difficulty=difficulty)
    raise ValueError(f"room: expected story or random, got {name!r}")


def namo_episode(
    agent: str, room: Room, seed: int, *, delay: int = 0
) -> tuple[NamoRecord, RoomBelief]:
    """One agent in one room.

    Args:
        agent: one of `CHARACTERS`.
        room: the room, the truth included.
        seed: of sensors, of what is drawn from beliefs, of the planner.
        delay: of the poses and twists that it reads, in steps.

    Returns:
        What happened, and what is believed in the end.

    Raises:
        ValueError: no such agent, or a negative delay.
    """
    if agent not in CHARACTERS:
        raise ValueError(
            f"agent: expected one of {', '.join(CHARACTERS)}; got {agent!r}"
        )
    belief_key, episode_key = jax.random.split(jax.random.key(seed))
    belief = belief_of(agent, belief_key, room)
    record = run_namo(episode_key, room, CHARACTERS[agent], belief, delay=delay)
    return record, belief


def belief_of(agent: str, key: Key, room: Room) -> RoomBelief:
    """What an agent believes of a room at first."""
    if agent in ("physics", "physics-map"):
        return LearntRoom(key, room, is_point=agent == "physics-map")
    if agent == "prior":
        learnt = LearntRoom(key, room)
        draws = [learnt.belief(i).hypotheses for i in range(room.num_things)]
        return FixedRoom(room, draws)
    if agent == "true":
        return FixedRoom(room, true_numbers(room))
    return FixedRoom(room, [_as_usual(thing.label) for thing in room.things])


def true_numbers(room: Room) -> list[Params]:
    """What is true of each thing alone, as one hypothesis."""
    params = room_params(room, room_scene(room))
    pins = params.revolute
    owner = np.where(np.asarray(pins.active), np.asarray(pins.body_a), -1)
    found = []
    for index, thing in enumerate(room.things):
        row = slice(index, index + 1)
        lone = empty_params(1, num_revolute=1, num_wheel=1, num_ground=1)
        density = np.asarray(params.density)[row]
        if thing.kind == "fixed":
            density = np.full(1, _IMMOVABLE)
        revolute = lone.revolute
        if index in owner:
            slot = int(np.flatnonzero(owner == index)[0])
            own = slice(slot, slot + 1)
            revolute = type(pins)(
                active=pins.active[own],
                body_a=revolute.body_a,
                body_b=revolute.body_b,
                anchor_a=pins.anchor_a[own],
                anchor_b=pins.anchor_b[own],
                viscous=pins.viscous[own],
                dry=pins.dry[own],
            )
        one = dataclasses.replace(
            lone,
            density=on_device(density),
            revolute=revolute,
            wheel=jax.tree.map(lambda leaf, row=row: leaf[row], params.wheel),
            ground=jax.tree.map(lambda leaf, row=row: leaf[row], params.ground),
        )
        found.append(jax.tree.map(lambda leaf: leaf[None], one))
    return found


def _as_usual(label: str) -> Params:
    """One hypothesis: free, of the weight and friction that such things have."""
    lone = empty_params(1, num_revolute=1, num_wheel=1, num_ground=1)
    usual = dataclasses.replace(
        lone,
        density=on_device([LOOKS[label].density]),
        ground=type(lone.ground)(
            active=on_device([[True]], bool),
            dry=on_device([[_USUAL_FRICTION]]),
            viscous=on_device([[1e3]]),
        ),
    )
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], usual)
