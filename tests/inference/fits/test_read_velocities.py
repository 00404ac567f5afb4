"""Recordings of poses alone: what stands in for velocities, and what is found."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import boomdp_jax
from boomdp_jax.core.history import make_history
from boomdp_jax.inference.blocks.block import make_block, stack_blocks
from boomdp_jax.inference.fits.read_velocities import with_read_velocities
from boomdp_jax.physics import rollout, scene_spec_from_dict

BOX = {"name": "box", "shape": {"type": "box", "half_extents": [0.2, 0.25]}}
BOX |= {"pose": [0.1, 0.2, 0.5]}
COMMON = {"schema": "planar-scene-1", "dt": 0.02}
RATES = np.array([0.3, -0.2, 4.0])


def spec_of(**more):
    return scene_spec_from_dict({**COMMON, "bodies": [BOX], **more})


def table(state, episode=None):
    """Rows from states at rest of forces, `[instant, 6]`."""
    action = np.zeros((len(state) - 1, 1, 3))
    rows = state[:, None]
    return make_history(rows[:-1], action, rows[1:], 0.02, episode=episode)


def steady(num=12):
    """Even motion, an angle beyond half a turn with it."""
    time = 0.02 * np.arange(num + 1)[:, None]
    pose = time * RATES + [0.0, 0.0, 3.0]
    pose[:, 2] = np.angle(np.exp(1j * pose[:, 2]))
    return np.concatenate([pose, np.broadcast_to(RATES, pose.shape)], axis=1)


def targets_of(history):
    spec = spec_of(unknown={"revolute": 1})
    return stack_blocks([make_block(spec, (0,), history)])


def test_what_was_read_is_left_alone():
    targets = targets_of(table(steady()))
    assert with_read_velocities(targets) is targets


def test_even_motion_is_read_from_its_poses():
    truth = steady()
    bare = np.where(np.arange(6) < 3, truth, np.nan)
    # The fourth pose is missing, and the fifth has all.
    bare[3], bare[4] = np.nan, truth[4]
    before = targets_of(table(bare))
    data = with_read_velocities(before).log_likelihood.data
    assert not np.any(before.log_likelihood.data.steps.mask[0, 5:])
    seen = np.ones(len(truth), bool)
    seen[3] = False
    np.testing.assert_array_equal(
        data.first_mask[0, :, 0], seen[:-1, None] * np.ones(6)
    )
    np.testing.assert_array_equal(data.last_mask[0, :, 0], seen[1:, None] * np.ones(6))
    whole = (seen[:-1] & seen[1:])[:, None] * np.ones(6)
    np.testing.assert_array_equal(data.steps.mask[0, :, 0], whole)
    for found, rows in (
        (data.steps.state, truth[:-1]),
        (data.steps.next_state, truth[1:]),
    ):
        is_seen = ~np.isnan(rows) & (rows != truth[3]).any(axis=1, keepdims=True)
        np.testing.assert_allclose(
            np.where(is_seen, found[0, :, 0], rows), rows, atol=1e-9
        )


def test_tracks_do_not_tell_of_each_other():
    first, second = steady(5), steady(5) * [1, 1, 1, -1, -1, -1]
    second[:, :3] = second[::-1, :3]
    bare = np.where(np.arange(6) < 3, np.concatenate([first, second]), np.nan)
    rows = np.delete(np.arange(11), 5)
    state, after = bare[:-1, None][rows], bare[1:, None][rows]
    action, episode = np.zeros((10, 1, 3)), np.repeat([0, 1], 5)
    history = make_history(state, action, after, 0.02, episode=episode)
    data = with_read_velocities(targets_of(history)).log_likelihood.data
    expected = np.concatenate([first[:-1], second[:-1]])
    np.testing.assert_allclose(data.steps.state[0, :, 0], expected, atol=1e-9)
    np.testing.assert_allclose(data.start[0, [0, 5], 0], expected[[0, 5]], atol=1e-9)


@pytest.mark.slow
def test_a_pin_is_found_from_poses_alone():
    """Where it was taken for a wheel that holds, for certain, 40 nats less likely."""
    offset, angle = np.array([0.1, -0.15]), 0.5
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    place = turn @ offset + [0.1, 0.2]
    pin = {"type": "revolute", "a": "box", "b": "world", "anchor_a": offset.tolist()}
    constraints = [pin | {"anchor_b": place.tolist()}]
    constraints.append({"type": "ground", "a": "box", "dry": 0.1})
    bodies = [BOX | {"density": 40.0}]
    truth = scene_spec_from_dict(
        {**COMMON, "bodies": bodies, "constraints": constraints}
    )
    rng = np.random.default_rng(21)
    tables = []
    for _ in range(4):
        wrench = np.repeat(rng.normal(size=(6, 1, 3)) * [10.0, 10.0, 2.0], 8, axis=0)
        start = truth.initial_state()
        known = truth.scene, truth.params(), start, jnp.asarray(wrench)
        run, _ = jax.jit(rollout)(*known)
        states = np.concatenate([np.asarray(start.array)[None], np.asarray(run.array)])
        states[..., :3] += 1e-3 * rng.normal(size=states[..., :3].shape)
        states[..., 3:] = np.nan
        tables.append((states[:-1], wrench, states[1:]))
    state, action, after = (np.concatenate(part) for part in zip(*tables, strict=True))
    episode = np.repeat(np.arange(4), 48)
    history = make_history(state, action, after, 0.02, episode=episode)
    spec = spec_of(unknown={"revolute": 1, "wheel": 1, "ground": 1})
    posterior = boomdp_jax.infer(jax.random.key(0), spec, history)
    weights, params = posterior.weights, posterior.params
    has_pin = np.asarray(params.revolute.active)[:, 0]
    assert weights @ has_pin > 0.99
    anchor = np.asarray(params.revolute.anchor_b)[has_pin, 0]
    share = weights[has_pin] / weights[has_pin].sum()
    np.testing.assert_allclose(share @ anchor, place, atol=2e-3)
    mass = np.asarray(params.density)[:, 0] * 0.2
    mean = weights @ mass
    assert abs(mean - 8.0) < 4.0 * np.sqrt(weights @ (mass - mean) ** 2)
