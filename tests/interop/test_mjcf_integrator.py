"""Integrators that documents name: carts move as ours, and MJX and stiffness allow."""

import numpy as np
import pytest

from boomdp_jax.interop import to_mjcf
from boomdp_jax.interop.object_families import random_object
from tests.interop.mjcf_worlds import box, distance, run_mujoco, run_ours, scene


def wheeled(viscous):
    wheel = {"type": "wheel", "a": "box", "pose": [-0.2, 0.0, 0.6], "viscous": viscous}
    return scene([box("box", (0.3, 0.0, 0.0))], wheel, gravity=(0, 0))


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


def test_the_integrator_is_one_that_mjx_has_and_that_is_stable():
    spec = scene([box("box", (0.3, 0.0, 0.0))])
    assert 'integrator="implicitfast"' in to_mjcf(spec, spec.params())
    spec = wheeled([0.8, 15.0])
    assert 'integrator="RK4"' in to_mjcf(spec, spec.params())
    spec = wheeled([30.0, 4e4])
    assert 'integrator="implicitfast"' in to_mjcf(spec, spec.params())
    # Runge and Kutta's method takes a shorter time step.
    assert 'integrator="RK4"' in to_mjcf(spec, spec.params(), time_step=2e-5)
