"""Kinds of furniture learnt one by one beforehand, for a room full of them.

As the papers' successor did: each kind is pushed by itself on an empty floor, and what
is believed of it then is a handful of posterior draws. In the room every piece may be
of any kind, each as likely as another; what is known of a kind is made to fit the
outline of the piece: the density and rates per mass are the kind's, places on the body
are in proportion to its sides.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.agents.episode import read_state, scale_of_readings
from boomdp_jax.core.arrays import Key
from boomdp_jax.envs.environment import EnvParams
from boomdp_jax.envs.furniture import PIECES, Piece
from boomdp_jax.envs.living_room import LivingRoom
from boomdp_jax.experiments.teaching import Samples, taught
from boomdp_jax.inference.online.belief import OnlineBelief
from boomdp_jax.models.known_kinds import KnownKinds, pinned_where_it_is
from boomdp_jax.models.physics_model import PhysicsModel
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.state import State
from boomdp_jax.physics.step import step

_NUM_PUSHES, _NUM_DRAWS = 64, 8
_NUM_PARTICLES = 256


def furniture_kinds(
    key: Key,
    task: LivingRoom,
    params: EnvParams,
    reading_noise: Float[Array, "4"] | None = None,
) -> tuple[KnownKinds, ...]:
    """A belief for each piece over all kinds of furniture there are.

    Args:
        key: random key, of no episode.
        task: the room.
        params: its world.
        reading_noise: standard deviation of the readings that kinds are learnt from.

    Returns:
        One for each piece.
    """
    kinds = {
        piece.name.rstrip(" 0123456789"): body for body, piece in enumerate(PIECES)
    }
    learnt = {
        body: _learnt(jax.random.fold_in(key, body), task, params, body, reading_noise)
        for body in kinds.values()
    }
    return tuple(
        KnownKinds(
            spec.scene,
            _side_by_side(
                [
                    fitted_to(draws, PIECES[body], PIECES[own])
                    for body, draws in learnt.items()
                ]
            ),
        )
        for own, spec in enumerate(task.pieces)
    )


def fitted_to(draws: Params, kind: Piece, piece: Piece) -> Params:
    """What is known of a kind, of a piece with another outline.

    Args:
        draws: hypotheses about the kind, leading axis `hypothesis`.
        kind: the piece that it was learnt on.
        piece: the one that may be of this kind.
    """
    sides = np.divide(piece.half_extents, kind.half_extents)
    mass = float(np.prod(sides))
    wheel, ground, pins = draws.wheel, draws.ground, draws.revolute
    track, shift = wheel.half_track, ground.load_shift
    start = jnp.asarray([[*piece.start, 0.0]], pins.anchor_b.dtype)
    fitted = dataclasses.replace(
        draws,
        wheel=dataclasses.replace(
            wheel,
            position=_times(wheel.position, sides),
            viscous=wheel.viscous * mass,
            dry=wheel.dry * mass,
            half_track=None if track is None else track * float(np.sqrt(mass)),
        ),
        ground=dataclasses.replace(
            ground,
            viscous=ground.viscous * mass,
            load_shift=None if shift is None else _times(shift, sides),
        ),
        revolute=dataclasses.replace(pins, anchor_a=_times(pins.anchor_a, sides)),
    )
    at_start = State(start, jnp.zeros_like(start))
    fitted = jax.vmap(lambda one: pinned_where_it_is(one, at_start))(fitted)
    return jax.tree.map(lambda new, old: new.astype(old.dtype), fitted, draws)


def _times(
    places: Float[Array, "*any 2"], sides: Float[np.ndarray, "2"]
) -> Float[Array, "*any 2"]:
    """Each coordinate by its own factor."""
    return places * sides.reshape((1,) * (places.ndim - 1) + (2,))


def _learnt(
    key: Key,
    task: LivingRoom,
    params: EnvParams,
    body: int,
    reading_noise: Float[Array, "4"] | None,
) -> Params:
    """Draws of what is believed of a piece that was pushed on an empty floor."""
    spec = task.pieces[body]
    truth = jax.tree.map(lambda leaf: leaf[body], task.lone_params(params.physics))
    push_key, noise_key, fit_key = jax.random.split(key, 3)
    scale = scale_of_readings(reading_noise)
    wrenches = task.piece_actions[body][:-1, None]
    pushes = jax.random.randint(push_key, (_NUM_PUSHES,), 0, len(wrenches))
    scene = spec.scene

    def push(state: State, row: tuple[Array, Array]) -> tuple[State, tuple[Array, ...]]:
        wrench, key = wrenches[row[0]], row[1]
        moved = step(scene, truth, state, wrench)[0]
        keys = jax.random.split(key)
        read = [
            read_state(one, each, scale).array
            for one, each in zip(keys, (state, moved), strict=True)
        ]
        return moved, (read[0], wrench, read[1])

    pose = jnp.asarray([[*PIECES[body].start, 0.0]], float)
    keys = jax.random.split(noise_key, _NUM_PUSHES)
    rows = jax.lax.scan(push, State(pose, jnp.zeros_like(pose)), (pushes, keys))[1]
    arrays = [np.asarray(part) for part in rows]
    samples = Samples(*arrays, np.ones((_NUM_PUSHES, 1), bool))
    online = OnlineBelief(spec, capacity=_NUM_PUSHES, num_particles=_NUM_PARTICLES)
    model = PhysicsModel(
        online, lambda physics, state, wrench: step(scene, physics, state, wrench)[0]
    )
    draws = taught(fit_key, model, samples).belief.hypotheses
    return jax.tree.map(lambda leaf: leaf[:_NUM_DRAWS], draws)


def _side_by_side(draws: list[Params]) -> Params:
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *draws)
