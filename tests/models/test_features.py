import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.models import BodyFeatures
from boomdp_jax.physics import State

from .worlds import cart, part, ride


def turned(vector, angle):
    """By complex numbers, the third number as it is."""
    z = (vector[..., 0] + 1j * vector[..., 1]) * np.exp(1j * angle)
    return jnp.stack([z.real, z.imag, vector[..., 2]], axis=-1)


def moved(state, angle, shift):
    pose = turned(state.pose, angle) + jnp.array([[*shift, angle]])
    return State(pose, turned(state.twist, angle))


@pytest.mark.parametrize("frame", ["world", "body"])
def test_next_state_undoes_targets(frame):
    features = BodyFeatures(cart(walls=True).scene, frame=frame)
    rng = np.random.default_rng(0)
    state, after = (State(*jnp.asarray(rng.normal(size=(2, 2, 3)))) for _ in range(2))
    told = features.next_state(state, features.targets(state, after))
    np.testing.assert_allclose(told.array[0], after.array[0], atol=1e-12)
    np.testing.assert_array_equal(told.array[1], state.array[1])


def test_coasting_bodies_have_targets_of_zero():
    scene = cart().scene
    state = State(jnp.array([[1.0, 2.0, 0.5]]), jnp.array([[0.3, -0.2, 0.7]]))
    after = State(state.pose + 0.1 * state.twist, state.twist)
    for frame in ("world", "body"):
        features = BodyFeatures(scene, frame=frame)
        np.testing.assert_allclose(features.targets(state, after), 0.0, atol=1e-15)


def test_body_frame_sees_the_same_wherever_the_world_is_looked_at_from():
    features = BodyFeatures(cart().scene, frame="body")
    for seed in range(3):
        angle, *shift = np.random.default_rng(seed).normal(size=3)
        before, wrench, after = part(ride(40), 3 * seed, 3 * seed + 1)
        rows = jax.tree.map(lambda leaf: leaf[0], (before, wrench, after))
        state, wrench, after = rows
        other, other_after = moved(state, angle, shift), moved(after, angle, shift)
        np.testing.assert_allclose(
            features.inputs(other, turned(wrench, angle)),
            features.inputs(state, wrench),
            atol=1e-9,
        )
        np.testing.assert_allclose(
            features.targets(other, other_after),
            features.targets(state, after),
            atol=1e-9,
        )


def test_body_frame_is_the_frame_of_the_body():
    features = BodyFeatures(cart().scene, frame="body")
    state = State(jnp.array([[5.0, 6.0, np.pi / 2]]), jnp.array([[0.0, 2.0, 0.3]]))
    wrench = jnp.array([[-3.0, 0.0, 1.5]])
    np.testing.assert_allclose(
        features.inputs(state, wrench)[0], [2.0, 0.0, 0.3, 0.0, 3.0, 1.5], atol=1e-12
    )


def test_world_frame_wraps_headings():
    features = BodyFeatures(cart().scene, frame="world")
    state = State(jnp.array([[5.0, 6.0, 7.0]]), jnp.zeros((1, 3)))
    seen = features.inputs(state, jnp.zeros((1, 3)))
    np.testing.assert_allclose(seen[0, :3], [5.0, 6.0, 7.0 - 2 * np.pi])
    after = State(jnp.array([[5.0, 6.0, 7.1 - 2 * np.pi]]), jnp.zeros((1, 3)))
    np.testing.assert_allclose(
        features.targets(state, after)[0], [0, 0, 0.1, 0, 0, 0], atol=1e-12
    )


@pytest.mark.parametrize(("frame", "num"), [("world", 6), ("body", 4)])
def test_without_angles_headings_stay(frame, num):
    features = BodyFeatures(cart().scene, frame=frame, angles=False)
    assert (features.num_inputs, features.num_outputs) == (num, 4)
    state = State(jnp.array([[1.0, 2.0, 0.5]]), jnp.array([[0.3, -0.2, 0.7]]))
    after = State(jnp.array([[1.1, 2.2, np.nan]]), jnp.array([[0.2, -0.1, np.nan]]))
    inputs = features.inputs(state, jnp.ones((1, 3)))
    targets = features.targets(state, after)
    assert inputs.shape == (1, num)
    told = features.next_state(state, targets)
    np.testing.assert_allclose(told.array[0, [0, 1, 3, 4]], [1.1, 2.2, 0.2, -0.1])
    np.testing.assert_array_equal(told.array[0, [2, 5]], [0.5, 0.7])


def test_bad_settings_are_refused():
    scene = cart().scene
    with pytest.raises(ValueError, match="frame: expected one of world, body; got 'w'"):
        BodyFeatures(scene, frame="w")
    with pytest.raises(ValueError, match=r"scene: expected a single one.*\(2, 1\)"):
        BodyFeatures(jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), scene))
    static = dataclasses.replace(scene, is_static=jnp.array([True]))
    with pytest.raises(ValueError, match="a body that can move; got 1 static"):
        BodyFeatures(static)
