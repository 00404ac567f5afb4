"""Energy, momentum and joint drift, by closed forms and by what motion keeps."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics import State, rollout
from boomdp_jax.physics.quantities import (
    angular_momentum,
    constraint_error,
    kinetic_energy,
    linear_momentum,
    mass_and_inertia,
    potential_energy,
    total_energy,
)
from tests.physics.scenes import make_params, make_scene, make_state
from tests.reference import planar_dynamics as reference
from tests.reference.planar_dynamics import Pin, Rod, World

LINKED = World(
    [(0.3, 0.1), (0.2, 0.05), (0.1, 0.1)],
    [20.0, 30.0, 50.0],
    pins=[Pin(0, (0.28, 0.0), (-0.18, 0.01), b=1)],
    rods=[Rod(1, (0.18, 0.0), (0.0, 0.1), 0.4, b=2)],
)
HEAVY = LINKED.with_(gravity=(0.7, -9.81))
QUANTITIES = [
    kinetic_energy,
    potential_energy,
    total_energy,
    linear_momentum,
    angular_momentum,
    constraint_error,
]


def random_state(seed: int = 0) -> State:
    pose, twist = np.random.default_rng(seed).normal(size=(2, 3, 3))
    return make_state(pose, twist)


def test_energy_and_momentum_are_sums_over_bodies(precision):
    scene, params = make_scene(HEAVY), make_params(HEAVY)
    state = random_state()
    pose, twist = np.asarray(state.pose, float), np.asarray(state.twist, float)
    tolerance = precision.choose(single=1e-5, double=1e-12)
    np.testing.assert_allclose(
        total_energy(scene, params, state),
        reference.energy(HEAVY, pose, twist),
        rtol=tolerance,
    )
    expected = reference.momentum(HEAVY, pose, twist)
    linear = linear_momentum(scene, params, state)
    np.testing.assert_allclose(linear, expected[:2], rtol=tolerance)
    np.testing.assert_allclose(
        angular_momentum(scene, params, state), expected[2], rtol=10 * tolerance
    )


def test_angular_momentum_about_another_point_differs_by_arm_times_momentum():
    scene, params, state = make_scene(LINKED), make_params(LINKED), random_state()
    momentum = np.asarray(linear_momentum(scene, params, state))
    here = angular_momentum(scene, params, state)
    there = angular_momentum(scene, params, state, (0.5, -2.0))
    np.testing.assert_allclose(here - there, 0.5 * momentum[1] + 2.0 * momentum[0])
    array = angular_momentum(scene, params, state, jnp.array([0.5, -2.0]))
    assert float(array) == float(there)


def test_momentum_is_the_slope_of_kinetic_energy_and_weight_that_of_potential():
    scene, params, state = make_scene(HEAVY), make_params(HEAVY), random_state()
    slope = jax.grad(kinetic_energy, argnums=2)(scene, params, state)
    np.testing.assert_allclose(
        jnp.sum(slope.twist[:, :2], axis=0), linear_momentum(scene, params, state)
    )
    _, inertia = mass_and_inertia(scene, params)
    np.testing.assert_allclose(slope.twist[:, 2], inertia * state.twist[:, 2])
    fall = jax.grad(potential_energy, argnums=2)(scene, params, state).pose
    np.testing.assert_allclose(fall[:, :2], -HEAVY.mass[:, None] * [HEAVY.gravity])
    np.testing.assert_array_equal(fall[:, 2], 0.0)


def test_a_falling_body_keeps_its_energy_and_gains_its_weight_in_momentum():
    world = World([(0.3, 0.1)], [20.0], gravity=(0.0, -9.81))
    scene, params = make_scene(world), make_params(world)
    start = make_state([[0.0, 0.0, 0.0]], [[1.0, 2.0, 3.0]])
    states, _ = rollout(scene, params, start, jnp.zeros((50, 1, 3)))
    energy = jax.vmap(total_energy, in_axes=(None, None, 0))(scene, params, states)
    np.testing.assert_allclose(energy, total_energy(scene, params, start), rtol=1e-12)
    momentum = jax.vmap(linear_momentum, in_axes=(None, None, 0))
    fallen = momentum(scene, params, states)[:, 1] - 2.0 * world.mass[0]
    time = 0.02 * np.arange(1, 51)
    np.testing.assert_allclose(fallen, -9.81 * world.mass[0] * time, rtol=1e-10)


@pytest.mark.slow
def test_joined_bodies_keep_momentum_that_no_single_one_keeps():
    world = World(
        [(0.3, 0.1), (0.2, 0.05)],
        [20.0, 30.0],
        pins=[Pin(0, (0.3, 0.0), (-0.3, 0.0), b=1)],
    )
    scene, params = make_scene(world, dt=0.005), make_params(world)
    start = make_state([[0, 0, 0], [0.6, 0, 0]], [[1, 2, 0], [0, 0, -3]])
    states, info = jax.jit(rollout)(scene, params, start, jnp.zeros((100, 2, 3)))

    def over_time(quantity):
        return jax.jit(jax.vmap(quantity, (None, None, 0)))(scene, params, states)

    # The twists of the start do not fit the pin: an impulse between the two sees to it.
    before = np.asarray(linear_momentum(scene, params, start))
    linear = over_time(linear_momentum)
    np.testing.assert_allclose(linear, np.tile(before, (100, 1)), atol=1e-9)
    angular = np.asarray(over_time(angular_momentum))
    np.testing.assert_allclose(angular, np.full(100, angular[0]), rtol=2e-3)
    alone = world.mass[0] * np.asarray(states.twist[:, 0, :2])
    assert np.ptp(alone) > 1.0, "joints exchanged nothing"
    np.testing.assert_allclose(
        over_time(constraint_error), info.constraint_error, atol=1e-12
    )


def test_constraint_error_is_the_gap_of_pins_and_the_stretch_of_rods(precision):
    world = World(
        [(0.3, 0.1), (0.2, 0.05)],
        [20.0, 30.0],
        pins=[Pin(0, (0.3, 0.0), (1.0, 2.0))],
        rods=[Rod(0, (0.0, 0.1), (0.0, 0.0), 0.5, b=1)],
    )
    scene, params = make_scene(world), make_params(world)

    def error(*pose):
        return float(constraint_error(scene, params, make_state(pose)))

    # Turned by a quarter, the pin's anchor is at (0, 0.3), the rod's at (-0.1, 0).
    quarter = np.pi / 2
    tight = precision.choose(single=1e-6, double=1e-12)
    fitting = (1.0, 1.7, quarter), (1.4, 1.7, 3.0)
    assert error(*fitting) == pytest.approx(0.0, abs=tight)
    shifted = (1.03, 1.74, quarter), (1.43, 1.74, 3.0)
    assert error(*shifted) == pytest.approx(0.05, abs=tight)
    stretched = (1.0, 1.7, quarter), (1.47, 1.7, 3.0)
    assert error(*stretched) == pytest.approx(0.07, abs=tight)
    squeezed = (1.0, 1.7, quarter), (1.3, 1.7, 3.0)
    assert error(*squeezed) == pytest.approx(0.1, abs=tight)


def test_inactive_joints_have_no_error_and_no_slope():
    scene, params, state = make_scene(LINKED), make_params(LINKED), random_state()
    off = eqx.tree_at(
        lambda p: (p.revolute.active, p.distance.active),
        params,
        (jnp.zeros(1, bool), jnp.zeros(1, bool)),
    )
    differentiate = jax.jit(jax.value_and_grad(constraint_error, argnums=2))
    value, slope = differentiate(scene, off, state)
    assert float(value) == 0.0
    np.testing.assert_array_equal(slope.pose, 0.0)
    bare = make_params(World([(0.1, 0.1)] * 3, [1.0] * 3))
    assert float(constraint_error(scene, bare, state)) == 0.0


def test_static_bodies_have_neither_momentum_nor_energy(precision):
    scene, params, state = make_scene(HEAVY), make_params(HEAVY), random_state()
    held = eqx.tree_at(lambda s: s.is_static, scene, jnp.array([True, False, True]))
    mass, inertia = mass_and_inertia(held, params)
    np.testing.assert_allclose(mass, HEAVY.mass * [0, 1, 0], rtol=1e-6)
    np.testing.assert_allclose(inertia, HEAVY.inertia * [0, 1, 0], rtol=1e-6)
    still = eqx.tree_at(
        lambda s: (s.pose, s.twist),
        state,
        (state.pose.at[::2].set(9.0), state.twist.at[::2].set(7.0)),
    )
    for quantity in QUANTITIES[:-1]:
        np.testing.assert_array_equal(
            quantity(held, params, still), quantity(held, params, state)
        )


def test_gradients_are_finite_where_joints_fit_exactly(precision):
    world = World([(0.3, 0.1)], [20.0], pins=[Pin(0, (0.0, 0.0), (0.0, 0.0))])
    world = world.with_(rods=[Rod(0, (0.0, 0.0), (0.0, 0.0), 0.5)])
    scene, params = make_scene(world), make_params(world)
    state = make_state([[0.0, 0.0, 0.0]])

    def everything(density, state):
        known = eqx.tree_at(lambda p: p.density, params, density)
        return [quantity(scene, known, state) for quantity in QUANTITIES]

    for derivative in (jax.jacrev, jax.jacfwd):
        slopes = jax.jit(derivative(everything, argnums=(0, 1)))(params.density, state)
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slopes))


@pytest.mark.slow
@pytest.mark.parametrize("quantity", QUANTITIES, ids=lambda q: q.__name__)
def test_jit_equals_eager_and_vmap_equals_a_loop(quantity):
    scene, params = make_scene(HEAVY), make_params(HEAVY)
    states = [random_state(seed) for seed in range(4)]
    alone = [quantity(scene, params, state) for state in states]
    many = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    together = jax.jit(jax.vmap(quantity, in_axes=(None, None, 0)))
    np.testing.assert_allclose(together(scene, params, many), alone, rtol=1e-12)


def test_a_state_of_another_scene_is_refused():
    scene, params = make_scene(LINKED), make_params(LINKED)
    with pytest.raises(ValueError, match="Scene has 3 bodies but the state 1; give"):
        constraint_error(scene, params, make_state([[0.0, 0.0, 0.0]]))
