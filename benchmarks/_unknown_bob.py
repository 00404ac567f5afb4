"""A bob of unknown mass on an arm with unknown friction, and noisy readings of it.

Force over weight is what decides how to get it up: at more than one it can be carried.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import boomdp_jax
from boomdp_jax.core.history import History, make_history
from boomdp_jax.envs import EnvParams, Pendulum
from boomdp_jax.envs.pendulum import DENSITY, FORCE_SHARE, pendulum_scene
from boomdp_jax.inference import infer_batch
from boomdp_jax.physics import SceneSpec, scene_spec_from_dict

SHARES, FRICTION = (0.7, 1.4), (0.01, 0.04)
"""Ranges of force over weight and of the joint's friction [N m s]."""
NOISE = (0.02, 0.02, 0.3, 0.5)
"""Of readings: place [m], angle [rad], velocity [m/s], spin [rad/s]."""


class World(NamedTuple):
    """One truth, and what was read of it."""

    number: int
    share: float
    params: EnvParams
    history: History

    @property
    def case(self) -> str:
        """For reports."""
        num_pushes = int(jnp.sum(self.history.mask))
        return (
            f"{num_pushes} pushes, truth {self.number}, "
            f"force {self.share:.2f} of the weight"
        )


def make_world(task: Pendulum, seed: int, number: int, num_pushes: int) -> World:
    """Draw a truth, push it at random, and read it with noise."""
    rng = np.random.default_rng([31, seed, number])
    share = float(np.exp(rng.uniform(*np.log(SHARES))))
    friction = float(np.exp(rng.uniform(*np.log(FRICTION))))
    params = task.default_params()
    pin = params.physics.revolute
    physics = dataclasses.replace(
        params.physics,
        density=jnp.full(1, DENSITY * FORCE_SHARE / share),
        revolute=dataclasses.replace(pin, viscous=jnp.full_like(pin.viscous, friction)),
    )
    params = dataclasses.replace(params, physics=physics)
    pushes = jnp.asarray(rng.integers(task.num_actions - 1, size=num_pushes))

    def push(state, action):
        _, after, *_ = task.step(None, state, action, params)
        return after, after.physics

    @jax.jit
    def run(key):
        _, first = task.reset(key, params)
        return first.physics, jax.lax.scan(push, first, pushes)[1]

    first, later = run(jax.random.key(int(rng.integers(2**31))))
    path = np.concatenate(
        [
            np.concatenate([np.asarray(one.pose), np.asarray(one.twist)], axis=-1)
            for one in (jax.tree.map(lambda leaf: leaf[None], first), later)
        ]
    )
    place, angle, velocity, spin = NOISE
    noise = np.array([place, place, angle, velocity, velocity, spin])
    readings = path + noise * rng.normal(size=path.shape)
    wrench = np.asarray(task.actions.wrench)[np.asarray(pushes)]
    dt = float(task.scene.dt)
    history = make_history(readings[:-1], wrench, readings[1:], dt)
    return World(number, share, params, history)


def what_is_open() -> SceneSpec:
    """The pendulum, of which mass and friction are to be found."""
    scene = pendulum_scene(is_known=True).to_dict()
    scene["bodies"][0]["density"] = None
    scene["constraints"][0]["viscous"] = None
    return scene_spec_from_dict(scene, "pendulum")


def learn(
    worlds: list[World], seed: int
) -> tuple[list[boomdp_jax.Posterior], list[boomdp_jax.Posterior]]:
    """Posteriors, and the most probable hypotheses."""
    key = jax.random.key(seed)
    specs, histories = [what_is_open()] * len(worlds), [w.history for w in worlds]
    return (
        infer_batch(key, specs, histories, method="smc"),
        infer_batch(key, specs, histories, method="map"),
    )
