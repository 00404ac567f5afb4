"""Worlds that differ from what agents are told: each by a law of its own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.envs import CART_WORLDS, Cart
from boomdp_jax.envs.cart import CART_OUTLINE, DENSITY
from boomdp_jax.envs.cart_worlds import (
    CASTER_DRY,
    DRY_FLOOR,
    DRY_WHEEL,
    OFF_CENTRE,
    TOO_LARGE,
    VISCOUS,
)
from boomdp_jax.envs.walls import wall_separation
from boomdp_jax.physics import State
from boomdp_jax.physics.scene_spec import STANDARD_GRAVITY
from boomdp_jax.physics.shapes import polygon_moments

MASS = DENSITY * polygon_moments(np.array(CART_OUTLINE)).area
AT = (1.7, 1.2, 0.4)
STEP = 0.4


def after_a_step(name, speed, force=0.0):
    """Twist in the frame of the cart after a step ahead, without walls near."""
    task = Cart(world=name)
    direction = jnp.array([np.cos(AT[2]), np.sin(AT[2]), 0.0])
    state = State(jnp.array([AT]), speed * direction[None])
    end = jax.jit(task.happens)(
        task.default_params().physics, state, force * direction[None]
    )
    c, s = np.cos(float(end.pose[0, 2])), np.sin(float(end.pose[0, 2]))
    x, y, spin = np.asarray(end.twist[0])
    return c * x + s * y, c * y - s * x, spin


@pytest.mark.slow
def test_as_told_is_what_agents_believe():
    task = Cart()
    params = task.default_params()
    state = task.start(jax.random.key(0), params)
    for action in (0, 3):
        row = (params.physics, state, task.actions[action])
        np.testing.assert_allclose(
            task.happens(*row).array, task.advance(*row).array, atol=1e-13
        )


@pytest.mark.slow
def test_dry_wheels_and_floor_brake_at_a_constant_rate():
    friction = DRY_WHEEL[0] + DRY_FLOOR * MASS * STANDARD_GRAVITY
    for speed, force in ((1.2, 0.0), (0.5, 30.0)):
        ahead, across, spin = after_a_step("dry", speed, force)
        expected = speed + (force - friction) * STEP / MASS
        np.testing.assert_allclose(ahead, expected, rtol=1e-3)
        np.testing.assert_allclose([across, spin], 0.0, atol=1e-9)
    ahead, _, _ = after_a_step("dry", 0.0, 0.8 * friction)
    assert abs(ahead) < 0.02


@pytest.mark.slow
def test_a_caster_drags_with_a_constant_force_besides():
    ratio, speed = CASTER_DRY / VISCOUS[0], 1.5
    decay = np.exp(-VISCOUS[0] * STEP / MASS)
    ahead, across, spin = after_a_step("caster", speed)
    np.testing.assert_allclose(ahead, (speed + ratio) * decay - ratio, rtol=0.03)
    np.testing.assert_allclose([across, spin], 0.0, atol=1e-9)


@pytest.mark.slow
def test_a_push_turns_a_cart_that_is_heavier_on_one_side():
    assert after_a_step("as-told", 0.0, 20.0)[2] == pytest.approx(0.0, abs=1e-12)
    spin = after_a_step("off-centre", 0.0, 20.0)[2]
    # The force passes the centre of mass on the other side of where that lies.
    assert np.sign(spin) == np.sign(OFF_CENTRE[1])
    assert abs(spin) > 0.02


def test_wrong_outlines_are_told_about_the_same_centroid():
    true = polygon_moments(np.array(CART_OUTLINE))
    for name, area in (("large", TOO_LARGE**2), ("box", 1.0)):
        task = Cart(world=name)
        told = polygon_moments(np.asarray(task.spec.scene.vertices[0]))
        np.testing.assert_allclose(told.centroid, 0.0, atol=1e-12)
        np.testing.assert_allclose(told.area, area * true.area, rtol=1e-12)
        assert told.gyration != pytest.approx(true.gyration, rel=1e-3)
        np.testing.assert_allclose(
            np.asarray(task.spec.bodies[0].moments.centroid), true.centroid, atol=1e-12
        )


@pytest.mark.slow
def test_walls_stop_the_true_outline_and_not_the_told_one():
    task = Cart(world="large")
    physics = task.default_params().physics
    wrench, state = (
        task.actions[4],
        State(jnp.array([[1.2, 1.2, 0.0]]), jnp.zeros((1, 3))),
    )
    advance, happens = jax.jit(task.advance), jax.jit(task.happens)
    told = true = state
    for _ in range(12):
        told, true = advance(physics, told, wrench), happens(physics, true, wrench)
    gap = wall_separation(task.walls, task.true_outline, true.pose[0])
    gap_told = wall_separation(task.walls, task.outline, told.pose[0])
    assert float(gap) >= 0.0
    assert float(gap_told) >= 0.0
    assert float(true.pose[0, 0]) < float(told.pose[0, 0]) - 0.04


@pytest.mark.slow
def test_starts_are_clear_in_every_world():
    for name in CART_WORLDS:
        task = Cart(world=name)
        params = task.default_params()
        keys = jax.random.split(jax.random.key(0), 32)
        poses = jax.vmap(lambda key, t=task, p=params: t.start(key, p))(keys).pose[:, 0]
        gap = jax.vmap(lambda p, t=task: wall_separation(t.walls, t.true_outline, p))
        assert float(jnp.min(gap(poses))) > 0.0


def test_another_world_is_refused():
    with pytest.raises(ValueError, match=r"world: expected one of as-told, .*wet"):
        Cart(world="wet")
