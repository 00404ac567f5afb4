"""Geweke's joint test: moves and data redrawn in turn keep the joint distribution.

Structure and coordinates are drawn from the prior and data from the likelihood; then a
move given the data and new data given the coordinates alternate. Whatever the posterior
is, the joint distribution then stays as it was, unless a move is wrong. The angle's
likelihood jumps at its seam, which no move may mind. The test is only worth something
if it fails on mistakes: several are planted by changing what a move hands on. Geweke
(2004), Getting it right.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.random_numbers import draw_noise
from boomdp_jax.inference.samplers import moves
from boomdp_jax.inference.samplers.laplace_mixture import make_mixture
from tests.inference.linear_gaussian import (
    PRIOR,
    SLOT,
    LinearLikelihood,
    in_use,
    make_target,
    two_sided,
)

FALSE_ALARM = 1e-4
NOISE_SCALE = 1.0
ANGLES = np.array([0.0, 0.0, 0.0, 2.5, 0.0])
DESIGN = 0.8 * np.random.default_rng(4).normal(size=(4, SLOT.size))
USED = np.array([in_use(index) for index in range(len(PRIOR))])


def target_given(data):
    likelihood = LinearLikelihood(jnp.asarray(DESIGN), data, jnp.asarray(NOISE_SCALE))
    return make_target(likelihood, ANGLES)


def wide_mixture(target):
    """Off-centre components with strong correlations."""
    rng = np.random.default_rng(2)
    num, dim = len(PRIOR), SLOT.size
    factor = 0.7 * np.eye(dim) + np.tril(0.4 * rng.normal(size=(num, dim, dim)), -1)
    return make_mixture(
        target,
        jnp.arange(num),
        jnp.asarray(0.4 * rng.normal(size=(num, dim))),
        jnp.asarray(factor),
        jnp.asarray(rng.normal(size=num)),
    )


def jump(key, point, target, mixture, *, drawn_from=None, alter=lambda point: point):
    draw_key, accept_key = jax.random.split(key)
    draw = (mixture if drawn_from is None else drawn_from).sample(draw_key, target)
    candidate = moves.evaluate(target, mixture, draw.structure, draw.z, draw.is_inside)
    uniform = jax.random.uniform(accept_key)
    return moves.jump(uniform, alter(point), alter(candidate))[0]


def change(key, point, target, mixture, *, alter=lambda target, point, made: made):
    noise = draw_noise(key, target.dim, mixture.degrees_of_freedom)
    made = moves.propose_change(noise, point, target, mixture, 0.4)
    made = alter(target, point, made)
    return moves.decide(noise.choice[3], point, target, mixture, made)[0]


def walk(key, point, target, mixture, *, alter=lambda target, point, made: made):
    noise = draw_noise(key, target.dim, mixture.degrees_of_freedom)
    size = jnp.asarray(0.7)
    made = moves.propose_walk(noise, point, target, mixture, size)
    made = alter(target, point, made)
    return moves.decide(noise.choice[3], point, target, mixture, made)[0]


def leap(key, point, target, mixture):
    return moves.leap(key, point, target, mixture, jnp.asarray(0.5), 2)[0]


def forget_density(point):
    return eqx.tree_at(lambda p: p.log_proposal, point, jnp.zeros(()))


def misjudge_density(point):
    """Ten per cent too high in every other structure."""
    off = jnp.log(1.1) * (point.structure % 2)
    return eqx.tree_at(lambda p: p.log_proposal, point, point.log_proposal + off)


def transposed_jump(key, point, target, mixture):
    factor = jnp.swapaxes(mixture.scale_tril, -1, -2)
    wrong = eqx.tree_at(lambda m: m.scale_tril, mixture, factor)
    return jump(key, point, target, mixture, drawn_from=wrong)


def forget_correction(target, point, made):
    return made._replace(log_correction=jnp.zeros(()))


def forget_rates(target, point, made):
    num_forward = jnp.sum(moves.neighbours(target, point.structure))
    num_backward = jnp.sum(moves.neighbours(target, made.structure))
    rates = jnp.log(num_forward) - jnp.log(num_backward)
    return made._replace(log_correction=made.log_correction - rates)


def swap_ratio(target, point, made):
    return made._replace(log_correction=-made.log_correction)


def joint_scores(move, num_chains: int = 6000, num_rounds: int = 12) -> np.ndarray:
    """Standard errors by which moments of (structure, z, data) are off."""
    rng = np.random.default_rng(0)
    structure = rng.choice(len(PRIOR), size=num_chains, p=PRIOR)
    z = rng.normal(size=(num_chains, SLOT.size))
    turn = rng.uniform(-0.5, 0.5, size=z.shape) * ANGLES
    z = np.where(USED[structure], np.where(ANGLES > 0, turn, z), 0.0)
    mixture = wide_mixture(target_given(jnp.zeros(len(DESIGN))))

    def redraw(key, z):
        noise = NOISE_SCALE * jax.random.normal(key, (len(DESIGN),))
        return jnp.asarray(DESIGN) @ z + noise

    @jax.jit
    @jax.vmap
    def run(key, structure, z):
        def iterate(carry, key):
            structure, z = carry
            data_key, move_key = jax.random.split(key)
            target = target_given(redraw(data_key, z))
            point = moves.evaluate(target, mixture, structure, z)
            point = move(move_key, point, target, mixture)
            return (point.structure, point.z), None

        keys = jax.random.split(key, num_rounds)
        (structure, z), _ = jax.lax.scan(iterate, (structure, z), keys)
        return structure, z

    keys = jax.random.split(jax.random.key(1), num_chains)
    structure, z = jax.tree.map(
        np.asarray, run(keys, jnp.asarray(structure, jnp.int32), jnp.asarray(z))
    )
    values = [(structure == index) - PRIOR[index] for index in range(len(PRIOR))]
    used = USED[structure]
    for index in range(SLOT.size):
        here = used[:, index]
        if ANGLES[index] > 0:
            phase = 2 * np.pi * z[:, index] / ANGLES[index]
            values += [here * np.cos(phase), here * np.sin(phase)]
        else:
            values += [here * z[:, index], here * (z[:, index] ** 2 - 1.0)]
    values += [z[:, 0] * z[:, 1], z[:, 1] * z[:, 2], z[:, 0] * z[:, 2]]
    values = np.array(values)
    return values.mean(axis=1) / (values.std(axis=1) / np.sqrt(num_chains))


@pytest.mark.slow
@pytest.mark.parametrize("move", [jump, change, walk, leap])
def test_joint_distribution_is_kept(move):
    scores = joint_scores(move)
    assert np.max(np.abs(scores)) < two_sided(FALSE_ALARM, scores.size)


MISTAKES = {
    "jump forgets its density": lambda *args: jump(*args, alter=forget_density),
    "jump drawn with a transposed factor": transposed_jump,
    "change forgets its densities": lambda *args: change(
        *args, alter=forget_correction
    ),
    "change forgets its move rates": lambda *args: change(*args, alter=forget_rates),
    "change with its ratio upside down": lambda *args: change(*args, alter=swap_ratio),
    "walk forgets its density": lambda *args: walk(*args, alter=forget_correction),
    "walk with its ratio upside down": lambda *args: walk(*args, alter=swap_ratio),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MISTAKES)
def test_planted_mistakes_are_caught(name):
    scores = joint_scores(MISTAKES[name])
    assert np.max(np.abs(scores)) > two_sided(FALSE_ALARM, scores.size)


@pytest.mark.slow
@pytest.mark.parametrize("move", [jump, change, walk, leap])
def test_joint_distribution_is_kept_in_many_chains(move):
    scores = joint_scores(move, num_chains=60_000, num_rounds=40)
    assert np.max(np.abs(scores)) < two_sided(FALSE_ALARM, scores.size)


@pytest.mark.slow
def test_a_density_ten_per_cent_off_is_caught_in_many_chains():
    def off(*args):
        return jump(*args, alter=misjudge_density)

    scores = joint_scores(off, num_chains=60_000, num_rounds=40)
    assert np.max(np.abs(scores)) > two_sided(FALSE_ALARM, scores.size)
