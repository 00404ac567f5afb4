"""Predictions through collisions beside closed forms of where discs go."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.inference.posteriors.predict import predict
from boomdp_jax.physics.scene_spec import scene_spec_from_dict
from boomdp_jax.physics.state import state_from_array
from tests.inference.made_posteriors import draws_like, make_posterior
from tests.inference.two_discs import (
    DT,
    RADIUS,
    approaching,
    discs_spec,
    state_at,
)

MASS, BOUNCE, RUB = (1.5, 0.8), 0.6, 0.2
NUMBERS = (*MASS, BOUNCE, RUB)
SD = 1e-3
NOISE = SD * np.array([1.0, 1.0, 5.0])
NUM_DRAWS = 64
# The hit is half-way.
NUM_ROWS = 20


def certain(spec, num_draws=NUM_DRAWS, sd=SD) -> Posterior:
    """A posterior that knows everything but where bodies are."""
    params = draws_like(spec.params(), num_draws)
    posterior = make_posterior(
        spec, params, params, noise_scale=(sd, 5.0 * sd, 1.0, 1.0)
    )
    quiet = jnp.full((num_draws, spec.num_bodies, 2), 1e-6)
    return dataclasses.replace(posterior, impulse_scale=quiet)


def known_discs():
    density = np.array(MASS) / (np.pi * RADIUS**2)
    return discs_spec(
        density=tuple(density), contact={"friction": RUB, "restitution": BOUNCE}
    )


def seen(rng, poses) -> History:
    """Noisy readings of poses `[episode, reading, body, 3]`, NaN where none."""
    state = np.full((*poses.shape[:-1], 6), np.nan)
    state[..., :3] = poses + NOISE * rng.standard_normal(poses.shape)
    num = poses.shape[1] - 1
    first, last = (
        each.reshape(-1, *each.shape[2:]) for each in (state[:, :-1], state[:, 1:])
    )
    return make_history(
        first,
        np.zeros((*first.shape[:2], 3)),
        last,
        DT,
        episode=np.repeat(np.arange(len(poses)), num),
    )


@pytest.mark.slow
def test_intervals_through_collisions_of_discs_hold_what_they_say():
    """Positions and angles only: starts are filtered through the same collisions."""
    poses = []
    for number in range(100):
        rng = np.random.default_rng([7, number])
        start = approaching(rng, rng.uniform(0.48, 0.52) * NUM_ROWS * DT)
        times = DT * np.arange(NUM_ROWS + 1)
        poses.append([state_at(start, NUMBERS, time)[:, :3] for time in times])
    with jax.enable_x64(False):
        history = seen(np.random.default_rng(8), np.array(poses))
        found = predict(certain(known_discs()), history, (1, 8), num_draws=NUM_DRAWS)
    assert found["starts"] == "filtered"
    for horizon in ("1", "8"):
        scores = found["horizons"][horizon]
        # Readings of one collision go together: a hundred of them are some three
        # hundred independent ones, and this three standard errors. With impacts as
        # they fall into the engine's substeps 0.85 a step on, and 0.82 ten steps on.
        assert scores["position"]["coverage90"] == pytest.approx(0.9, abs=0.05)
        assert scores["angle"]["coverage90"] == pytest.approx(0.9, abs=0.05)


@pytest.mark.slow
def test_transitions_through_a_collision_are_those_of_the_closed_form():
    posterior = certain(known_discs(), num_draws=1, sd=1e-7)
    posterior = dataclasses.replace(
        posterior,
        noise_scale=jnp.full((1, 2, 4), 1e-7),
        impulse_scale=None,
    )
    rng = np.random.default_rng(3)
    touch = rng.uniform(0.2, 0.8, 32) * DT
    starts = np.stack([approaching(rng, each) for each in touch])
    draw = jax.jit(
        jax.vmap(
            lambda state: posterior.transition(
                jax.random.key(0), state_from_array(state), jnp.zeros((2, 3))
            )
        )
    )
    after = np.asarray(draw(jnp.asarray(starts)).array)
    exact = np.stack([state_at(start, NUMBERS, DT) for start in starts])
    # By the engine's own steps speeds are off by up to several centimetres a second.
    assert np.abs(after - exact)[..., 3:5].max() < 1e-3
    assert np.abs(after - exact)[..., :2].max() < 1.5e-4


def bounced(rng, e: float) -> np.ndarray:
    """States of a disc and of the wall that it hits half-way, without friction."""
    speed, along = rng.uniform(0.5, 1.5), rng.uniform(-0.5, 0.5)
    turn, spin = rng.uniform(-1.0, 1.0, 2)
    time = DT * np.arange(NUM_ROWS + 1)
    touch = rng.uniform(0.48, 0.52) * NUM_ROWS * DT
    rate = np.where(time < touch, speed, -e * speed)
    still = np.zeros_like(time)
    place = [rate * (time - touch) - 0.1, along * time, turn + spin * time]
    disc = np.stack([*place, rate, still + along, still + spin], axis=-1)
    wall = np.broadcast_to([0.1, 0.0, 0.0, 0.0, 0.0, 0.0], disc.shape)
    return np.stack([disc, wall], axis=1)


def ball_and_wall():
    contact = {"friction": 0.0, "restitution": 0.5}
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": DT,
            "bodies": [
                {
                    "name": "ball",
                    "shape": {"type": "circle", "radius": 0.1},
                    "contact": contact,
                    "density": 30.0,
                },
                {
                    "name": "wall",
                    "shape": {"type": "box", "half_extents": [0.1, 3.0]},
                    "pose": [0.1, 0.0, 0.0],
                    "static": True,
                    "contact": contact,
                },
            ],
        },
        source="test",
    )


@pytest.mark.slow
def test_walls_stand_where_the_scene_has_them_whether_read_or_not():
    spec = ball_and_wall()
    rng = np.random.default_rng(5)
    poses = np.stack([bounced(rng, 0.5)[..., :3] for _ in range(100)])
    poses[:, :, 1] = np.nan
    with jax.enable_x64(False):
        history = seen(rng, poses)
        found = predict(certain(spec), history, (1, 8), num_draws=NUM_DRAWS)
    for horizon in ("1", "8"):
        scores = found["horizons"][horizon]["position"]
        # As above, of one body.
        assert scores["coverage90"] == pytest.approx(0.9, abs=0.06)
        # Of a wall whose place is not known nobody could say where a ball comes back.
        assert scores["rmse"] < 12.0 * SD


@pytest.mark.slow
def test_unread_walls_stand_there_where_predictions_start_from_whole_readings():
    spec, rng = ball_and_wall(), np.random.default_rng(6)
    states = np.stack([bounced(rng, 0.5) for _ in range(4)])
    states[:, :, 1] = np.nan
    rows = (states[:, :-1], states[:, 1:])
    state, after = (each.reshape(-1, *each.shape[2:]) for each in rows)
    history = make_history(state, np.zeros((len(state), 2, 3)), after, DT)
    exact = certain(spec, sd=1e-7)
    exact = dataclasses.replace(exact, noise_scale=jnp.full((NUM_DRAWS, 2, 4), 1e-7))
    found = predict(exact, history, (1,), num_draws=NUM_DRAWS)
    assert found["starts"] == "readings"
    assert found["num_starts"]["1"] == len(state)
    scores = found["horizons"]["1"]
    assert scores["position"]["rmse"] < 1e-4
    assert scores["velocity"]["rmse"] < 1e-3
