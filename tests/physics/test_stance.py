"""Feet that the scene leaves open, against the same legs given one by one."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics import State, rollout, step
from boomdp_jax.physics.scene_spec import scene_spec_from_dict
from boomdp_jax.physics.shapes import diagonal_loads, foot_loads

CORNERS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
HALF, TILT = np.array([0.3, 0.1]), 0.4
TURN = np.array([[math.cos(TILT), -math.sin(TILT)], [math.sin(TILT), math.cos(TILT)]])
BOXES = {
    "box": ({"type": "box", "half_extents": HALF.tolist()}, np.eye(2)),
    # The same one, drawn askew.
    "polygon": (
        {"type": "polygon", "vertices": (CORNERS[[2, 3, 0, 1]] * HALF @ TURN.T)},
        TURN,
    ),
}


def world(shape, feet=None, *, is_pair=False):
    """One body on a floor, or two that a rod holds together."""
    shape = {
        key: value.tolist() if isinstance(value, np.ndarray) else value
        for key, value in shape.items()
    }
    body = {"name": "body", "shape": shape, "density": 20.0, "pose": [0.0, 0.0, 0.0]}
    body |= {} if feet is None else {"feet": np.asarray(feet).tolist()}
    bodies, ties = [body], [{"type": "ground", "a": "body", "dry": 0.3}]
    if is_pair:
        bodies.append(body | {"name": "other", "pose": [1.0, 0.2, 0.5]})
        ties.append({"type": "ground", "a": "other", "dry": 0.2})
        rod = {"type": "distance", "a": "body", "b": "other", "length": math.sqrt(1.04)}
        ties.append(rod | {"anchor_a": [0.0, 0.0], "anchor_b": [0.0, 0.0]})
    content = {"schema": "planar-scene-1", "dt": 0.01, "bodies": bodies}
    return scene_spec_from_dict(content | {"constraints": ties})


def with_stance(params, **stance):
    """The same for every body."""
    shape = params.ground.dry.shape
    filled = {
        name: jnp.broadcast_to(jnp.asarray(value, float), (*shape, *np.shape(value)))
        for name, value in stance.items()
    }
    return dataclasses.replace(
        params, ground=dataclasses.replace(params.ground, **filled)
    )


def run(spec, params):
    """Pushed, turned and let go."""
    state = spec.initial_state()
    twist = jnp.tile(jnp.asarray([[0.3, -0.5, 4.0]]), (spec.num_bodies, 1))
    wrench = jnp.zeros((20, spec.num_bodies, 3)).at[:6].set([6.0, 3.0, 1.0])
    return np.asarray(
        rollout(spec.scene, params, State(state.pose, twist), wrench)[0].array
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "is_pair",
    [False, pytest.param(True, marks=pytest.mark.slow)],
    ids=["lone", "tied"],
)
@pytest.mark.parametrize("name", BOXES)
def test_all_load_on_the_corners_is_four_legs(name, is_pair):
    shape, turn = BOXES[name]
    # Corner feet of an even pressure stand at 0.95 of two thirds of the outline.
    scale = np.array([0.8, 1.3])
    legs = (CORNERS * HALF * 0.95 * 2.0 / 3.0 * scale) @ turn.T
    given, left_open = (world(shape, feet, is_pair=is_pair) for feet in (legs, None))
    stance = with_stance(left_open.params(), stance_scale=scale, corner_share=1.0)
    expected = run(given, given.params())
    np.testing.assert_allclose(run(left_open, stance), expected, atol=1e-9)
    assert np.max(np.abs(run(left_open, left_open.params()) - expected)) > 0.01


@pytest.mark.parametrize("is_told", [True, False])
def test_a_diagonal_that_carries_all_is_two_legs(is_told):
    legs = CORNERS * HALF * 0.95 * 2.0 / 3.0
    spec = world(BOXES["box"][0], legs if is_told else None)
    which = int(spec.scene.diagonal[0, 0] < 0)
    params = with_stance(spec.params(), diagonal_share=1.0)
    if not is_told:
        params = with_stance(params, corner_share=1.0)
        # Of nine feet the first stands where the third leg does: on the same diagonal.
    two = world(BOXES["box"][0], legs[which::2])
    np.testing.assert_allclose(run(spec, params), run(two, two.params()), atol=1e-9)


@pytest.mark.slow
def test_half_of_the_load_on_a_diagonal_changes_nothing():
    spec = world(BOXES["polygon"][0])
    params = with_stance(
        spec.params(), stance_scale=[1.0, 1.0], corner_share=0.0, diagonal_share=0.5
    )
    np.testing.assert_array_equal(run(spec, params), run(spec, spec.params()))


def test_a_body_stands_about_its_centre_of_mass():
    """An even pressure, or legs however far apart, turn nothing that only slides."""
    spec = world(BOXES["box"][0])
    params = dataclasses.replace(
        with_stance(spec.params(), stance_scale=[1.5, 0.7], corner_share=0.5),
        center_of_mass=jnp.asarray([[0.1, 0.02]]),
    )
    state = State(spec.initial_state().pose, jnp.asarray([[0.5, 0.2, 0.0]]))
    end, _ = step(spec.scene, params, state, jnp.zeros((1, 3)))
    assert abs(float(end.twist[0, 2])) < 1e-9
    assert float(jnp.linalg.norm(end.twist[0, :2])) < 0.52


@pytest.mark.slow
def test_derivatives_by_the_stance_are_those_of_differences():
    spec = world(BOXES["polygon"][0])

    def end(numbers):
        params = with_stance(
            spec.params(),
            stance_scale=numbers[:2],
            corner_share=numbers[2],
            diagonal_share=numbers[3],
        )
        state = State(spec.initial_state().pose, jnp.asarray([[0.3, -0.5, 4.0]]))
        return jnp.sum(
            jnp.sin(step(spec.scene, params, state, jnp.ones((1, 3)))[0].array)
        )

    numbers = jnp.asarray([1.2, 0.8, 0.6, 0.4])
    slopes = jax.jit(jax.grad(end))(numbers)
    value = jax.jit(end)
    for i in range(4):
        ahead, behind = (float(value(numbers.at[i].add(h))) for h in (1e-5, -1e-5))
        assert float(slopes[i]) == pytest.approx((ahead - behind) / 2e-5, rel=1e-4)


def test_loads_that_change_along_a_diagonal_still_balance():
    rng = np.random.default_rng(4)
    for num in (4, 5, 7):
        feet = rng.normal(size=(num, 2))
        feet -= feet.mean(axis=0)
        load = foot_loads(feet)
        change = diagonal_loads(feet, load)
        assert np.max(change) == pytest.approx(1.0)
        assert np.min(change) >= -1.0
        np.testing.assert_allclose(
            [*(load * change) @ feet, load @ change], 0.0, atol=1e-12
        )


def test_three_legs_have_no_diagonal():
    feet = np.array([[1.0, 0.0], [-1.0, 1.0], [-1.0, -1.0]])
    np.testing.assert_array_equal(diagonal_loads(feet, foot_loads(feet)), 0.0)
    np.testing.assert_array_equal(diagonal_loads(CORNERS[:2], np.full(2, 0.5)), 0.0)
