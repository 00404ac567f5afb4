"""Where a rod is guessed to be, from motion that it allowed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import boomdp_jax
from boomdp_jax.core.history import make_history
from boomdp_jax.inference.blocks.block import make_block, stack_blocks
from boomdp_jax.inference.fits.fit_starts import Guesses
from boomdp_jax.inference.fits.rod_guess import rod_guess
from boomdp_jax.physics import WORLD, rollout, scene_spec_from_dict

ANCHOR, PLACE = np.array([0.2, 0.1]), np.array([0.6, 0.5])
POSE = np.array([0.1, -0.2, 0.3])
BOX = {"shape": {"type": "box", "half_extents": [0.3, 0.2]}}
COMMON = {"schema": "planar-scene-1", "dt": 0.02}
WHEEL = {"type": "wheel", "a": "box", "pose": [-0.2, 0.05, 0.9]}
WHEEL |= {"viscous": [4.0, 70.0], "dry": [0.3, 6.0]}


def seen_from(point):
    """A point of the box in the frame of the world."""
    cos, sin = np.cos(POSE[2]), np.sin(POSE[2])
    return POSE[:2] + np.array([[cos, -sin], [sin, cos]]) @ point


LENGTH = float(np.hypot(*(seen_from(ANCHOR) - PLACE)))


def moved(seed: int, constraints: list[dict], others=(), num: int = 60):
    """A scene's readings while its bodies are pushed about."""
    box = {"name": "box", "pose": POSE.tolist(), "density": 20.0, **BOX}
    bodies = [box, *others]
    truth = scene_spec_from_dict(
        {**COMMON, "bodies": bodies, "constraints": constraints}
    )
    rng = np.random.default_rng(seed)
    wrench = rng.normal(size=(num // 10, len(bodies), 3)) * [60.0, 60.0, 12.0]
    wrench = np.repeat(wrench, 10, axis=0)
    start = truth.initial_state()
    known = truth.scene, truth.params(), start, jnp.asarray(wrench)
    run, _ = jax.jit(rollout)(*known)
    states = np.concatenate([np.asarray(start.array)[None], np.asarray(run.array)])
    noise = np.array([1e-3, 1e-3, 1e-3, 4e-3, 4e-3, 4e-3])
    noisy = states + noise * rng.normal(size=states.shape)
    return make_history(noisy[:-1], wrench, noisy[1:], 0.02)


def rod(second: str, place: np.ndarray, length: float) -> dict:
    ends = {"anchor_a": ANCHOR.tolist(), "anchor_b": place.tolist()}
    return {"type": "distance", "a": "box", "b": second, "length": length, **ends}


@pytest.mark.slow
def test_a_rod_to_the_world_is_found_beside_a_wheel():
    box = {"name": "box", "pose": POSE.tolist(), **BOX}
    unknown = {"distance": 1, "wheel": 1}
    spec = scene_spec_from_dict({**COMMON, "bodies": [box], "unknown": unknown})
    constraints = [rod("world", PLACE, LENGTH), WHEEL]
    histories = [moved(seed, constraints) for seed in range(3)]
    targets = stack_blocks([make_block(spec, (0,), history) for history in histories])
    guesses = Guesses.of(targets)
    coordinates = targets.log_likelihood.coordinates
    slot = coordinates.layout.slots[0]
    assert slot.kind == "distance"
    assert np.all(guesses.has[:, slot.start : slot.start + 5])
    found = jax.vmap(lambda map_, z: map_(z, jnp.ones(2, bool)).distance)(
        coordinates, jnp.asarray(guesses.z)
    )
    for index in range(3):
        np.testing.assert_allclose(found.anchor_a[index, 0], ANCHOR, atol=0.02)
        np.testing.assert_allclose(found.anchor_b[index, 0], PLACE, atol=0.06)
        np.testing.assert_allclose(found.length[index, 0], LENGTH, atol=0.06)


@pytest.mark.slow
def test_a_rod_between_bodies_is_found():
    other = {"name": "other", "pose": [0.9, 0.6, -0.4], "density": 30.0, **BOX}
    cos, sin = np.cos(-0.4), np.sin(-0.4)
    offset = np.array([-0.1, 0.15])
    turned = [cos * offset[0] - sin * offset[1], sin * offset[0] + cos * offset[1]]
    length = float(np.hypot(*(np.array([0.9, 0.6]) + turned - seen_from(ANCHOR))))
    history = moved(3, [rod("other", offset, length)], [other])
    boxes = [{"name": "box", "pose": POSE.tolist(), **BOX}, other]
    spec = scene_spec_from_dict({**COMMON, "bodies": boxes})
    data = make_block(spec, (0, 1), history).target.log_likelihood.data.steps
    unit = jnp.asarray([0.6, 0.6])
    noise = (1e-3, 5e-3)
    first, second, found = rod_guess(data, 0, 1, unit, jnp.zeros(2), noise)
    np.testing.assert_allclose(first, ANCHOR, atol=0.02)
    np.testing.assert_allclose(second, offset, atol=0.02)
    np.testing.assert_allclose(found, length, atol=0.03)


def test_without_readings_a_guess_is_finite():
    history = moved(0, [rod("world", PLACE, LENGTH)])
    box = {"name": "box", "pose": POSE.tolist(), **BOX}
    spec = scene_spec_from_dict({**COMMON, "bodies": [box]})
    data = make_block(spec, (0,), history).target.log_likelihood.data.steps
    data = jax.tree.map(jnp.zeros_like, data)
    parts = rod_guess(data, 0, WORLD, jnp.ones(2), jnp.zeros(2), (1e-3, 5e-3))
    assert all(np.all(np.isfinite(part)) for part in parts)


@pytest.mark.slow
def test_a_rod_and_a_wheel_are_told_together():
    """Four of six such were a wheel alone without a doubt."""
    box = {"name": "box", "pose": POSE.tolist(), **BOX}
    unknown = {"distance": 1, "wheel": 1}
    spec = scene_spec_from_dict({**COMMON, "bodies": [box], "unknown": unknown})
    constraints = [rod("world", PLACE, LENGTH), WHEEL]
    histories = [moved(10 + seed, constraints) for seed in range(6)]
    found = boomdp_jax.infer_batch(jax.random.key(0), [spec] * 6, histories)
    for posterior in found:
        params, weights = posterior.params, posterior.weights
        both = np.asarray(params.distance.active)[:, 0]
        both = both & np.asarray(params.wheel.active)[:, 0, 0]
        assert weights @ both > 0.95
        density = np.log(np.asarray(params.density)[:, 0])
        assert abs(weights @ density - np.log(20.0)) < 4.0 * density.std()
