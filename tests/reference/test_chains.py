"""The chain's reference keeps its energy and agrees with the multiplier form."""

import numpy as np

from tests.reference import chains, planar_dynamics
from tests.reference.planar_dynamics import Pin, World

HALF_LENGTH, HALF_WIDTH, DENSITY = 0.15, 0.03, 20.0


def uneven_chain() -> chains.Chain:
    rng = np.random.default_rng(0)
    return chains.Chain(
        length=rng.uniform(0.2, 0.5, 4),
        centre=rng.uniform(0.0, 0.3, 4),
        mass=rng.uniform(0.5, 2.0, 4),
        inertia=rng.uniform(0.01, 0.1, 4),
    )


def test_an_uneven_chain_keeps_its_energy():
    chain = uneven_chain()
    angle = np.array([0.3, -1.0, 2.0, 0.1])
    times = np.linspace(0.0, 2.0, 21)
    path = chains.integrate(chain, angle, np.array([1.0, -2.0, 0.5, 3.0]), times)
    energies = chains.energy(chain, chains.states(chain, *path))
    assert np.ptp(path[0]) > 1.0
    np.testing.assert_allclose(energies, energies[0], rtol=1e-8)


def test_twists_are_the_rates_of_the_poses():
    chain = uneven_chain()
    angle, spin = np.array([0.3, -1.0, 2.0, 0.1]), np.array([1.0, -2.0, 0.5, 3.0])
    step = 1e-6
    ahead = chains.states(chain, angle + step * spin, spin)
    behind = chains.states(chain, angle - step * spin, spin)
    slope = (ahead - behind)[:, :3] / (2.0 * step)
    np.testing.assert_allclose(
        slope, chains.states(chain, angle, spin)[:, 3:], atol=1e-8
    )


def test_a_chain_of_bars_moves_as_bodies_held_by_multipliers():
    chain = chains.bars(
        3, half_length=HALF_LENGTH, half_width=HALF_WIDTH, density=DENSITY
    )
    end, start = (HALF_LENGTH, 0.0), (-HALF_LENGTH, 0.0)
    world = World(
        [(HALF_LENGTH, HALF_WIDTH)] * 3,
        [DENSITY] * 3,
        gravity=(0.0, -9.81),
        pins=[Pin(0, start, (0.0, 0.0)), Pin(0, end, start, 1), Pin(1, end, start, 2)],
    )
    angle, spin = np.array([0.2, 0.9, -0.4]), np.array([0.0, 1.0, -1.0])
    times = np.linspace(0.0, 0.6, 7)
    path = chains.states(chain, *chains.integrate(chain, angle, spin, times))
    pose, twist = planar_dynamics.integrate(
        world, path[0, :, :3], path[0, :, 3:], times
    )
    np.testing.assert_allclose(path[..., :3], pose, atol=1e-6)
    np.testing.assert_allclose(path[..., 3:], twist, atol=1e-5)


def test_one_link_swings_with_the_period_of_a_small_pendulum():
    chain = chains.bars(
        1, half_length=HALF_LENGTH, half_width=HALF_WIDTH, density=DENSITY
    )
    about_pin = chain.inertia[0] + chain.mass[0] * HALF_LENGTH**2
    period = 2 * np.pi * np.sqrt(about_pin / (chain.mass[0] * 9.81 * HALF_LENGTH))
    tilt = 1e-4
    angle, _ = chains.integrate(
        chain, [-np.pi / 2 + tilt], [0.0], np.array([0.5, 1.0]) * period
    )
    np.testing.assert_allclose(angle[:, 0] + np.pi / 2, [-tilt, tilt], rtol=1e-4)
