"""Derivatives through contact: closed forms, finite differences, both modes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics import Params, State, Surface, rollout
from tests.physics.contact_scenes import FLOOR, body, fixed, spec_of

# Each of the two programs takes half a minute to compile in 64 bit.
pytestmark = pytest.mark.slow

NUM_STEPS = 15


def _final(scene, params, state, density, friction, restitution, speed):
    """Where bodies end, by factors on one's density, both surfaces, one's speed."""
    surface = Surface(
        params.surface.friction * friction, params.surface.restitution * restitution
    )
    changed = {"density": params.density.at[1].multiply(density), "surface": surface}
    start = State(state.pose, state.twist.at[1].multiply(speed))
    wrenches = jnp.zeros((NUM_STEPS, *state.pose.shape))
    states, _ = rollout(scene, Params(**{**vars(params), **changed}), start, wrenches)
    return jnp.concatenate([states.pose[-1, 1:], states.twist[-1, 1:]], axis=-1)


_run = jax.jit(_final)
_forward, _backward = (
    jax.jit(mode(_final, argnums=(3, 4, 5, 6))) for mode in (jax.jacfwd, jax.jacrev)
)


def _jacobians(spec):
    """Derivatives with respect to the four factors, in both modes."""
    given = (spec.scene, spec.params(), spec.initial_state(), 1.0, 1.0, 1.0, 1.0)
    return np.stack(_forward(*given), -1), np.stack(_backward(*given), -1)


def test_sliding_box_has_the_derivatives_of_coulombs_law():
    box = body("box", (0.2, 0.1), (0.0, 0.1, 0.0), (3.0, 0.0, 0.0), friction=0.3)
    floor = fixed("floor", (20.0, 0.5), (0.0, -0.5, 0.0), friction=0.3)
    spec = spec_of(floor, box, body("far", 0.1, (9.0, 0.1, 0.0)))
    forward, backward = _jacobians(spec)
    assert np.allclose(forward, backward, atol=1e-9)
    t = NUM_STEPS / 60
    # v = v0 - mu g t, x = v0 t - mu g t^2 / 2, whatever its mass.
    friction, speed, density = forward[0, :, 1], forward[0, :, 3], forward[0, :, 0]
    assert friction[3] == pytest.approx(-0.3 * 9.81 * t, rel=0.01)
    assert friction[0] == pytest.approx(-0.3 * 9.81 * t**2 / 2, rel=0.05)
    assert speed[3] == pytest.approx(3.0, rel=0.01)
    assert speed[0] == pytest.approx(3.0 * t, rel=0.01)
    assert abs(density[3]) < 1e-3


def test_colliding_balls_have_the_derivatives_of_newtons_law():
    contact = {"friction": 0.3, "restitution": 0.5}
    first = body("first", 0.1, (-0.2, 0.0, 0.0), (2.0, 0.0, 0.0), **contact)
    second = body("second", 0.2, (0.2, 0.0, 0.0), **contact)
    spec = spec_of(
        fixed("wall", (0.1, 0.1), (9.0, 9.0, 0.0), **contact),
        first,
        second,
        gravity=(0.0, 0.0),
    )
    forward, backward = _jacobians(spec)
    assert np.allclose(forward, backward, atol=1e-9)
    # With r = m1 / m2: v1 = v (r - e) / (r + 1), v2 = v r (1 + e) / (r + 1).
    ratio, e, v = 0.25, 0.5, 2.0
    by_density = ratio * v * (1 + e) / (1 + ratio) ** 2
    speeds = forward[:, 3]
    assert speeds[0, 0] == pytest.approx(by_density, rel=0.01)
    assert speeds[1, 0] == pytest.approx(by_density, rel=0.01)
    assert speeds[0, 2] == pytest.approx(-e * v / (1 + ratio), rel=0.01)
    assert speeds[1, 2] == pytest.approx(e * v * ratio / (1 + ratio), rel=0.01)
    assert speeds[0, 3] == pytest.approx(v * (ratio - e) / (1 + ratio), rel=0.01)
    assert speeds[1, 3] == pytest.approx(v * ratio * (1 + e) / (1 + ratio), rel=0.01)


def test_derivatives_through_a_tumble_are_those_of_finite_differences():
    box = body("box", (0.2, 0.1), (0.0, 0.35, 0.4), (1.0, -1.0, 2.0), restitution=0.3)
    ball = body("ball", 0.1, (0.5, 0.1, 0.0), (-1.0, 0.0, 0.0))
    spec = spec_of(FLOOR, box, ball)
    forward, backward = _jacobians(spec)
    assert np.all(np.isfinite(forward))
    assert np.allclose(forward, backward, atol=1e-8)
    given, step = (spec.scene, spec.params(), spec.initial_state()), 1e-6
    for i in range(4):
        ends = [
            [1.0 + sign * step * (i == k) for k in range(4)] for sign in (1.0, -1.0)
        ]
        up, down = (np.asarray(_run(*given, *end)) for end in ends)
        slope = (up - down) / (2 * step)
        scale = np.max(np.abs(slope)) + 1e-3
        assert np.max(np.abs(slope - forward[..., i])) < 1e-3 * scale


@pytest.mark.parametrize("shift", [0.0, -1e-3])
def test_derivatives_are_finite_where_bodies_just_touch_or_overlap(shift):
    twin = body("twin", (0.1, 0.1), (0.2 + shift, 0.1, 0.0))
    spec = spec_of(FLOOR, body("box", (0.1, 0.1), (0.0, 0.1, 0.0)), twin)
    forward, backward = _jacobians(spec)
    assert np.all(np.isfinite(forward))
    assert np.all(np.isfinite(backward))


def test_derivatives_are_finite_where_centres_coincide():
    spec = spec_of(FLOOR, body("a", 0.1, (0.0, 0.5, 0.0)), body("b", 0.1, (0, 0.5, 0)))
    forward, backward = _jacobians(spec)
    assert np.all(np.isfinite(forward))
    assert np.all(np.isfinite(backward))


def _pushed_end(scene, params, state, force):
    """Where a box ends that a disc is pushed against, along the push."""
    wrenches = jnp.zeros((60, 2, 3)).at[:, 0, 0].set(force)
    states, _ = rollout(scene, params, state, wrenches)
    return states.pose[-1, 1, 0]


_end = jax.jit(_pushed_end)
_slopes = [jax.jit(mode(_pushed_end, argnums=3)) for mode in (jax.jacfwd, jax.jacrev)]


def _smoothed(spec, speed):
    scene = dataclasses.replace(spec.scene, smoothing=jnp.asarray(speed))
    return scene, spec.params(), spec.initial_state()


def test_smoothing_tells_of_what_does_not_touch_yet():
    disc = body("disc", 0.1, (-0.5, 0.0, 0.0))
    spec = spec_of(disc, body("box", (0.1, 0.1), (0.0, 0.02, 0.0)), gravity=(0.0, 0.0))
    sharp = spec.scene, spec.params(), spec.initial_state()
    # 0.2 N do not bring the disc to the box in a second, 2 N do.
    assert float(_slopes[0](*sharp, 0.2)) == 0.0
    for force in (0.2, 0.42, 2.0):
        difference = _end(*_smoothed(spec, 0.05), force + 1e-5)
        difference = (difference - _end(*_smoothed(spec, 0.05), force - 1e-5)) / 2e-5
        assert float(difference) > 1e-4
        for slope in _slopes:
            found = float(slope(*_smoothed(spec, 0.05), force))
            assert found == pytest.approx(float(difference), rel=1e-5)
    errors = [
        abs(float(_end(*_smoothed(spec, speed), 2.0) - _end(*sharp, 2.0)))
        for speed in (0.05, 0.01, 0.002)
    ]
    assert errors[0] > 2.0 * errors[1] > 4.0 * errors[2]
    assert errors[2] < 1e-3


@pytest.mark.parametrize("is_pinned", [False, True])
def test_smoothing_pushes_with_its_square_over_the_gap(is_pinned):
    gap, speed = 0.05, 0.01
    ends = [body(f"disc {i}", 0.1, (i * (0.2 + gap), 0.0, 0.0)) for i in range(2)]
    pin = {"type": "revolute", "a": "disc 0", "b": "world"}
    pin |= {"anchor_a": [0.0, 0.0], "anchor_b": [0.0, 0.0]}
    spec = spec_of(*ends, gravity=(0.0, 0.0), constraints=[pin] if is_pinned else [])
    scene, params, state = _smoothed(spec, speed)
    states, _ = jax.jit(rollout)(scene, params, state, jnp.zeros((3, 2, 3)))
    apart = float(states.twist[-1, 1, 0] - states.twist[-1, 0, 0])
    assert apart == pytest.approx(speed**2 / gap * 3 / 60, rel=0.02)


def test_a_smoothed_tower_stands():
    boxes = [body(f"box{i}", (0.2, 0.1), (0.0, 0.1 + 0.2 * i, 0.0)) for i in range(5)]
    scene, params, state = _smoothed(spec_of(FLOOR, *boxes), 0.05)
    states, info = jax.jit(rollout)(scene, params, state, jnp.zeros((300, 6, 3)))
    assert np.max(np.abs(states.pose[-1] - state.pose)) < 5e-3
    assert np.max(info.overlap) < 1e-3
