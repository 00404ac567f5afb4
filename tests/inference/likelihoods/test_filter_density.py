"""The filter for many points against joint densities, and against particles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.likelihoods.filter_density import filter_density
from boomdp_jax.inference.likelihoods.kalman import NoiseLevel, extended_filter
from boomdp_jax.inference.readings.track_data import track_data
from boomdp_jax.physics import State, step
from boomdp_jax.physics.scene_spec import scene_spec_from_dict
from tests.inference.joint_normal import joint_normal
from tests.inference.recordings import (
    AREA,
    DT,
    MASS,
    SIZE,
    box_scene,
    free_box,
    lacking,
)

READING = np.array([1e-3, 2e-3, 5e-3, 4e-3])
IMPULSE = np.array([3e-3, 2e-3])
LOG_NOISE = np.log(np.concatenate([READING, IMPULSE]))


def level(num_bodies: int = 1) -> NoiseLevel:
    return NoiseLevel(
        jnp.tile(jnp.asarray(READING), (num_bodies, 1)),
        jnp.tile(jnp.asarray(IMPULSE), (num_bodies, 1)),
    )


def density_of_box(history: History, mass: float) -> float:
    spec = box_scene(density=mass / AREA)
    data = track_data(history, (0,), True)
    return float(filter_density(spec.scene, spec.params(), data, level()))


@pytest.mark.slow
@pytest.mark.parametrize("mass", [MASS, 1.1 * MASS])
def test_density_is_that_of_all_readings_together(mass):
    history = free_box(np.random.default_rng(0), 12)
    expected = joint_normal(history).log_density(mass, jnp.asarray(LOG_NOISE))
    np.testing.assert_allclose(density_of_box(history, mass), expected, rtol=1e-6)


@pytest.mark.slow
def test_second_readings_and_gaps_are_taken_as_by_the_other_filter():
    """That one is checked against the joint density of such readings by itself."""
    history = free_box(np.random.default_rng(2), 10, is_chained=False, num_episodes=2)
    rng = np.random.default_rng(3)
    first, last = jnp.asarray(rng.random((2, 10, 1, 6)) > 0.3)
    changed = {
        "state_mask": first,
        "next_state_mask": last,
        "state": jnp.where(first, history.state, 0.0),
        "next_state": jnp.where(last, history.next_state, 0.0),
    }
    history = History(**{**vars(history), **changed})
    spec = box_scene(density=MASS / AREA)
    data = track_data(history, (0,), True)
    expected = extended_filter(spec.scene, spec.params(), data, level())
    found = density_of_box(history, MASS)
    np.testing.assert_allclose(found, expected.log_likelihood, rtol=1e-9)


def two_bodies(constraints: list[dict]):
    """Two boxes of known density."""
    box = {"shape": {"type": "box", "half_extents": SIZE}, "density": MASS / AREA}
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, 0.0],
            "dt": DT,
            "bodies": [{"name": "a", **box}, {"name": "b", **box}],
            "constraints": constraints,
        },
        source="test",
    )


def side_by_side(left: History, right: History) -> History:
    return make_history(
        jnp.concatenate([left.state, right.state], axis=1),
        jnp.concatenate([left.action, right.action], axis=1),
        jnp.concatenate([left.next_state, right.next_state], axis=1),
        DT,
    )


@pytest.mark.slow
def test_bodies_that_are_not_tied_are_independent():
    each = [free_box(np.random.default_rng(seed), 8) for seed in (4, 5)]
    spec = two_bodies([])
    data = track_data(side_by_side(*each), (0, 1), True)
    found = filter_density(spec.scene, spec.params(), data, level(2))
    expected = sum(density_of_box(history, MASS) for history in each)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.slow
def test_bodies_that_are_tied_are_filtered_as_by_the_other_filter():
    each = [free_box(np.random.default_rng(seed), 8) for seed in (4, 5)]
    tie = {"type": "revolute", "a": "a", "b": "b"}
    spec = two_bodies([{**tie, "anchor_a": [0.3, 0.0], "anchor_b": [-0.3, 0.1]}])
    data = track_data(side_by_side(*each), (0, 1), True)
    expected = extended_filter(spec.scene, spec.params(), data, level(2))
    found = filter_density(spec.scene, spec.params(), data, level(2))
    np.testing.assert_allclose(found, expected.log_likelihood, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["next", "start", "some"])
@pytest.mark.parametrize("freedom", [None, 4.0], ids=["normal", "student-t"])
def test_a_channel_that_one_end_of_an_instant_lacks_is_read_once(way, freedom):
    """Whatever the other channels do, and the other body, too."""
    each = [free_box(np.random.default_rng(seed), 8) for seed in (4, 5)]
    tie = {"type": "revolute", "a": "a", "b": "b"}
    spec = two_bodies([{**tie, "anchor_a": [0.3, 0.0], "anchor_b": [-0.3, 0.1]}])

    def density(history: History) -> float:
        data = track_data(history, (0, 1), True, freedom=freedom)
        return float(filter_density(spec.scene, spec.params(), data, level(2)))

    history, full = lacking(side_by_side(*each), way, body=1)
    found, expected = density(history), density(full)
    # By Student-t noise the order in which channels are taken matters a little.
    rtol = 1e-9 if freedom is None else 1e-3
    np.testing.assert_allclose(found, expected, rtol=rtol)
    one, same = lacking(each[1], way)
    np.testing.assert_allclose(
        density_of_box(one, MASS), density_of_box(same, MASS), rtol=1e-9
    )


@pytest.mark.slow
def test_a_body_that_is_read_twice_leaves_others_read_once():
    once = free_box(np.random.default_rng(4), 8)
    twice = free_box(np.random.default_rng(5), 8, is_chained=False)
    spec = two_bodies([])
    data = track_data(side_by_side(once, twice), (0, 1), True)
    found = filter_density(spec.scene, spec.params(), data, level(2))
    expected = density_of_box(once, MASS) + density_of_box(twice, MASS)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def pinned_box(rng: np.random.Generator, num_rows: int):
    """A box that swings about a pin, and noisy readings of it."""
    pin = {"type": "revolute", "a": "box", "b": "world"}
    spec = scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, 0.0],
            "dt": DT,
            "bodies": [
                {
                    "name": "box",
                    "shape": {"type": "box", "half_extents": SIZE},
                    "density": MASS / AREA,
                }
            ],
            "constraints": [{**pin, "anchor_a": [0.2, 0.1], "anchor_b": [0.2, 0.1]}],
        },
        source="test",
    )
    scale = np.repeat(READING, [2, 1, 2, 1])
    now = State(jnp.zeros((1, 3)), jnp.asarray([[-0.08, 0.16, 0.8]]))
    rows = [np.asarray(now.array[0])]
    action = rng.normal(size=(num_rows, 1, 3)) * [20.0, 20.0, 3.0]
    for t in range(num_rows):
        kick = jnp.asarray(rng.normal(size=(1, 3)) * IMPULSE[[0, 0, 1]])
        kicked = State(now.pose, now.twist + kick)
        now, _ = step(spec.scene, spec.params(), kicked, jnp.asarray(action[t]))
        rows.append(np.asarray(now.array[0]))
    noisy = np.stack(rows) + scale * rng.normal(size=(num_rows + 1, 6))
    return spec, make_history(noisy[:-1, None], action, noisy[1:, None], DT)


NUM_PARTICLES = 400_000


def by_particles(spec, history: History, twist_sd=None) -> list[float]:
    """Log-densities by a bootstrap particle filter, of one track of one body.

    It takes no derivative and no normal density.

    Args:
        spec: the scene, all of it known.
        history: one track.
        twist_sd: of the twist that it starts with, which is not read, and of those of
            the particles there; None: it is read.
    """
    scene, params = spec.scene, spec.params()
    scale = jnp.asarray(np.repeat(READING, [2, 1, 2, 1]))

    @jax.jit
    def advance(key, state, action):
        kick = jax.random.normal(key, (NUM_PARTICLES, 1, 3))
        kick = kick * jnp.asarray(IMPULSE[[0, 0, 1]])[None, None]
        kicked = State(state[..., :3], state[..., 3:] + kick)
        return jax.vmap(lambda s: step(scene, params, s, action)[0].array)(kicked)

    totals = []
    for seed in range(4):
        start_key, key = jax.random.split(jax.random.key(seed))
        noise = jax.random.normal(start_key, (NUM_PARTICLES, 1, 6))
        state = history.state[0][None] + noise * scale[None, None]
        weight = jnp.zeros(NUM_PARTICLES)
        if twist_sd is not None:
            prior, near = jnp.asarray(twist_sd)[:, None, None]
            unit = noise[..., 3:]
            state = state.at[..., 3:].set(near * unit)
            weight = 0.5 * unit**2 - 0.5 * (near * unit / prior) ** 2
            weight = jnp.sum(weight + jnp.log(near / prior), axis=(1, 2))
        total = 0.0
        for t in range(history.capacity):
            key, move_key, pick_key = jax.random.split(key, 3)
            state = advance(move_key, state, history.action[t])
            miss = (history.next_state[t][None] - state) / scale[None, None]
            each = -0.5 * miss**2 - jnp.log(scale * jnp.sqrt(2.0 * jnp.pi))[None, None]
            each = jnp.where(history.next_state_mask[t][None], each, 0.0)
            each = weight + jnp.sum(each, axis=(1, 2))
            total += float(jax.nn.logsumexp(each) - jnp.log(NUM_PARTICLES))
            weight = jnp.zeros(NUM_PARTICLES)
            cumulative = jnp.cumsum(jnp.exp(each - jnp.max(each)))
            places = (jnp.arange(NUM_PARTICLES) + jax.random.uniform(pick_key)) / (
                NUM_PARTICLES
            )
            chosen = jnp.searchsorted(cumulative, places * cumulative[-1])
            state = state[jnp.minimum(chosen, NUM_PARTICLES - 1)]
        totals.append(total)
    return totals


@pytest.mark.slow
def test_a_pinned_body_is_filtered_as_by_particles():
    spec, history = pinned_box(np.random.default_rng(7), 8)
    data = track_data(history, (0,), True)
    found = float(filter_density(spec.scene, spec.params(), data, level()))
    totals = by_particles(spec, history)
    spread = np.std(totals, ddof=1)
    assert spread < 0.3
    np.testing.assert_allclose(found, np.mean(totals), atol=0.1 + 3.0 * spread)


def box_on_a_floor(dry: float, *, is_pinned: bool = False, seed: int = 11):
    """A box that lies on a floor and is pushed; poses alone are read."""
    ground = {"type": "ground", "a": "box", "dry": dry}
    spec, _ = pinned_box(np.random.default_rng(0), 1)
    scene = spec.to_dict()
    scene["constraints"] = [*scene["constraints"][: int(is_pinned)], ground]
    # Seen from above: the floor carries it.
    scene.pop("gravity", None)
    spec = scene_spec_from_dict(scene, source="test")
    rng = np.random.default_rng(seed)
    now, num_rows = State(jnp.zeros((1, 3)), jnp.zeros((1, 3))), 12
    rows = [np.asarray(now.array[0])]
    action = np.tile(rng.normal(size=(1, 1, 3)) * [3.0, 3.0, 0.3], (num_rows, 1, 1))
    action[:2] = 0.0
    for t in range(num_rows):
        now, _ = step(spec.scene, spec.params(), now, jnp.asarray(action[t]))
        rows.append(np.asarray(now.array[0]))
    scale = np.repeat(READING, [2, 1, 2, 1])
    noisy = np.stack(rows) + scale * rng.normal(size=(num_rows + 1, 6))
    noisy[:, 3:] = np.nan
    return spec, make_history(noisy[:-1, None], action, noisy[1:, None], DT)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("is_pinned", "true_dry", "dry"),
    [(False, 0.3, 0.3), (True, 0.3, 0.3), (False, 0.0, 0.04)],
)
def test_friction_takes_away_no_more_of_an_unread_twist_than_it_can(
    is_pinned, true_dry, dry
):
    """From rest, which nobody knows of, friction holds whatever a push is less than."""
    _, history = box_on_a_floor(true_dry, is_pinned=is_pinned)
    spec, _ = box_on_a_floor(dry, is_pinned=is_pinned)
    data = track_data(history, (0,), True)
    found = float(filter_density(spec.scene, spec.params(), data, level()))
    gained = extended_filter(spec.scene, spec.params(), data, level())
    np.testing.assert_allclose(found, gained.log_likelihood, rtol=1e-9)
    totals = by_particles(spec, history, ([1.0, 1.0, 3.0], [0.2, 0.2, 0.4]))
    assert np.std(totals, ddof=1) < 0.6
    # Its sd is 1 m/s, of which a step's friction takes 0.06 m/s at most.
    np.testing.assert_allclose(found, np.mean(totals), atol=1.5)
