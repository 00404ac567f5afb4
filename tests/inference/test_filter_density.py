"""The filter for many points against joint densities, and against particles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.filter_density import filter_density
from boomdp_jax.inference.kalman import NoiseLevel, extended_filter
from boomdp_jax.inference.track_data import track_data
from boomdp_jax.physics import State, step
from boomdp_jax.physics.scene_spec import scene_spec_from_dict
from tests.inference.joint_normal import joint_normal
from tests.inference.recordings import AREA, DT, MASS, SIZE, box_scene, free_box

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


@pytest.mark.slow
def test_a_pinned_body_is_filtered_as_by_particles():
    """A bootstrap particle filter, which takes no derivative and no normal density."""
    num_rows, num_particles = 8, 100_000
    spec, history = pinned_box(np.random.default_rng(7), num_rows)
    data = track_data(history, (0,), True)
    scene, params = spec.scene, spec.params()
    found = float(filter_density(scene, params, data, level()))
    scale = jnp.asarray(np.repeat(READING, [2, 1, 2, 1]))

    @jax.jit
    def advance(key, state, action):
        kick = jax.random.normal(key, (num_particles, 1, 3))
        kick = kick * jnp.asarray(IMPULSE[[0, 0, 1]])[None, None]
        kicked = State(state[..., :3], state[..., 3:] + kick)
        return jax.vmap(lambda s: step(scene, params, s, action)[0].array)(kicked)

    totals = []
    for seed in range(4):
        key = jax.random.key(seed)
        start_key, key = jax.random.split(key)
        noise = jax.random.normal(start_key, (num_particles, 1, 6))
        state = history.state[0][None] + noise * scale[None, None]
        total = 0.0
        for t in range(num_rows):
            key, move_key, pick_key = jax.random.split(key, 3)
            state = advance(move_key, state, history.action[t])
            miss = (history.next_state[t][None] - state) / scale[None, None]
            each = -0.5 * jnp.sum(miss**2, axis=(1, 2)) - jnp.sum(jnp.log(scale))
            each = each - 3.0 * jnp.log(2.0 * jnp.pi)
            total += float(jax.nn.logsumexp(each) - jnp.log(num_particles))
            cumulative = jnp.cumsum(jnp.exp(each - jnp.max(each)))
            places = (jnp.arange(num_particles) + jax.random.uniform(pick_key)) / (
                num_particles
            )
            chosen = jnp.searchsorted(cumulative, places * cumulative[-1])
            state = state[jnp.minimum(chosen, num_particles - 1)]
        totals.append(total)
    spread = np.std(totals, ddof=1)
    assert spread < 0.3
    np.testing.assert_allclose(found, np.mean(totals), atol=0.1 + 3.0 * spread)
