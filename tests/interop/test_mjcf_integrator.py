"""Integrators that documents name: bodies move as ours, as MJX and stiffness allow."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.interop import to_mjcf
from boomdp_jax.interop.mjcf_export import _on_host
from boomdp_jax.interop.mjcf_integrator import largest_rate
from boomdp_jax.interop.object_families import random_object
from boomdp_jax.physics.friction import KNEE_SPEED
from tests.interop.mjcf_worlds import box, distance, joint, run_mujoco, run_ours, scene
from tests.interop.test_mjcf_export import WORLDS

MASS = 20.0 * 0.6 * 0.2
INERTIA = MASS * (0.6**2 + 0.2**2) / 12.0
PIN = joint("revolute", "box", "world", (-0.3, 0.0), (0.0, 0.0))
TOUCH = {"contact": {"friction": 0.4, "restitution": 0.0}}
SMOOTH = (
    "free body",
    "damped pendulum",
    "pendulum with both",
    "double pendulum",
    "drawer",
    "weld",
    "wheel",
    "four-bar loop",
)


def thing(**fields):
    return box("box", (0.3, 0.0, 0.0), **fields)


def wheeled(viscous):
    wheel = {"type": "wheel", "a": "box", "pose": [-0.2, 0.0, 0.6], "viscous": viscous}
    return scene([thing()], wheel, gravity=(0, 0))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_carts_move_as_ours_unless_couplings_are_left_out(seed):
    spec = random_object(np.random.default_rng(seed), "cart")
    params = spec.params()
    mass = float(params.density[0]) * spec.bodies[0].area
    wrench = [[4.0 * mass, 2.0 * mass, 0.3 * mass]]
    ours = run_ours(spec, params, 50, wrench, dt=spec.dt / 4)
    gaps = [
        distance(ours, run_mujoco(to_mjcf(spec, params, **options), spec, 50, wrench))
        for options in ({}, {"integrator": "implicitfast"})
    ]
    assert gaps[0] < 0.01
    assert gaps[1] > 5.0 * gaps[0]


def gaps_of(name):
    """Differences by the default and by "implicitfast", at MuJoCo's own time step."""
    spec, wrench = WORLDS[name]
    params = spec.params()
    ours = run_ours(spec, params, 50, wrench, dt=spec.dt / 40)
    return [
        distance(ours, run_mujoco(to_mjcf(spec, params, **options), spec, 50, wrench))
        for options in ({}, {"integrator": "implicitfast"})
    ]


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name == "double pendulum" else pytest.mark.slow)
        for name in SMOOTH
    ],
)
def test_what_is_smooth_moves_as_ours_by_the_default(name):
    usual, first_order = gaps_of(name)
    assert usual < 1e-6
    assert first_order > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(WORLDS.keys() - set(SMOOTH)))
def test_what_is_not_smooth_moves_no_worse_by_the_default(name):
    usual, first_order = gaps_of(name)
    assert usual < 1e-2
    assert usual <= first_order


def test_the_integrator_is_one_that_mjx_has_and_that_is_stable():
    spec = scene([thing()])
    assert 'integrator="RK4"' in to_mjcf(spec, spec.params())
    spec = scene([thing(**TOUCH), box("other", (2.0, 0.0, 0.0), **TOUCH)])
    assert 'integrator="implicitfast"' in to_mjcf(spec, spec.params())
    spec = wheeled([0.8, 15.0])
    assert 'integrator="RK4"' in to_mjcf(spec, spec.params())
    spec = wheeled([30.0, 4e4])
    assert 'integrator="implicitfast"' in to_mjcf(spec, spec.params())
    # Runge and Kutta's method takes a shorter time step.
    assert 'integrator="RK4"' in to_mjcf(spec, spec.params(), time_step=2e-5)
    spec = scene([thing()], PIN | {"viscous": 600.0 * INERTIA})
    assert 'integrator="implicitfast"' in to_mjcf(spec, spec.params())
    assert 'integrator="RK4"' in to_mjcf(spec, spec.params(), time_step=1e-3)


OTHER = box("other", (0.9, 0.0, 0.0), density=60.0)
BETWEEN = joint("revolute", "box", "other", (0.3, 0.0), (-0.3, 0.0), viscous=3.0)
RAIL = joint("prismatic", "box", "world", (0, 0), (0, 0), axis=0.7, angle=0.0)
CART = {"type": "wheel", "a": "box", "pose": [0.0, 0.0, 0.6], "viscous": [2.0, 9.0]}
RATES = {
    "nothing": ([thing()], [], 0.0),
    "pin": ([thing()], [PIN | {"viscous": 3.0}], 3.0 / INERTIA),
    "pin with a limit": (
        [thing()],
        [PIN | {"viscous": 3.0, "dry": 0.5}],
        3.0 / INERTIA,
    ),
    "pin that sticks": ([thing()], [PIN | {"dry": 0.5}], 0.0),
    "pin of two": ([thing(), OTHER], [BETWEEN], 3.0 / INERTIA + 1.0 / INERTIA),
    "pin of a static one": (
        [thing(), OTHER | {"static": True}],
        [BETWEEN],
        3.0 / INERTIA,
    ),
    "motor": (
        [thing()],
        [PIN | {"motor_speed": 1.0, "motor_torque": 0.4}],
        0.4 / KNEE_SPEED / INERTIA,
    ),
    "drawer": ([thing()], [RAIL | {"viscous": 3.0}], 3.0 / MASS),
    "drawer off centre": (
        [thing()],
        [RAIL | {"viscous": 3.0, "axis": 0.0, "anchor_a": [0.0, 0.2]}],
        3.0 / MASS + 3.0 * 0.2**2 / INERTIA,
    ),
    "wheel": ([thing()], [CART], 9.0 / MASS),
    "wheel off centre": (
        [thing()],
        [CART | {"pose": [0.2, 0.0, 0.0]}],
        9.0 / MASS + 9.0 * 0.2**2 / INERTIA,
    ),
    "floor": ([thing()], [{"type": "ground", "a": "box", "viscous": 3.0}], None),
}


@pytest.mark.parametrize("name", RATES)
def test_the_largest_rate_is_that_of_the_closed_form(name):
    bodies, constraints, expected = RATES[name]
    spec = scene(bodies, *constraints, gravity=(0, 0))
    if expected is None:
        body = spec.bodies[0]
        square = np.sum(body.feet**2, axis=1) + body.foot_size**2
        turning = 3.0 * float(body.foot_load @ square) / INERTIA
        expected = max(3.0 / MASS, turning)
    rate = largest_rate(spec, _on_host(spec, spec.params()))
    assert rate == pytest.approx(expected, rel=1e-6, abs=1e-12)


def test_two_wheels_of_an_axle_turn_the_body_as_well():
    spec = scene([thing()], CART | {"viscous": [9.0, 1.0]}, gravity=(0, 0))
    params = spec.params()
    wheel = dataclasses.replace(params.wheel, half_track=jnp.full((1, 1), 0.4))
    params = _on_host(spec, dataclasses.replace(params, wheel=wheel))
    rate = largest_rate(spec, params)
    assert rate == pytest.approx(9.0 * 0.4**2 / INERTIA, rel=1e-6)
