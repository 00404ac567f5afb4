"""Every move leaves the target invariant, alone and together."""

import warnings
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro.diagnostics import effective_sample_size
from scipy import stats

from boomdp_jax.core.random_numbers import draw_noise
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers import moves
from boomdp_jax.inference.samplers.chain_diagnostics import diagnose_chains
from boomdp_jax.inference.samplers.dual_averaging import (
    start_dual_averaging,
    update_dual_averaging,
)
from boomdp_jax.inference.samplers.laplace_mixture import make_mixture
from boomdp_jax.inference.samplers.mixture_building import (
    add_prior_components,
    add_slot_components,
)
from boomdp_jax.inference.samplers.structure_chain import (
    ChainSettings,
    init,
    proposal_keys,
    run_chains,
    step,
)
from tests.inference.linear_gaussian import (
    PRIOR,
    SLOT,
    STRUCTURES,
    NoLikelihood,
    closed_form,
    in_use,
    make_problem,
    make_target,
    sample_exactly,
    skewed_mixture,
    two_sided,
)

FALSE_ALARM = 1e-4
ANGLES = np.array([0.0, 2.0, 0.0, 3.0, 0.0])
# One size of run for several tests, so that it is compiled once.
RUN = {"num_chains": 4, "num_warmup": 50, "num_samples": 500}


def linear_case(seed=0):
    """A linear target, its closed form, and a mixture of skewed and prior parts."""
    target, design, data = make_problem(seed)
    _, probability, means, covariances = closed_form(design, data)
    mixture = skewed_mixture(target, means, covariances)
    return target, mixture, probability, means, covariances


def one_jump(key, point, target, mixture):
    draw_key, accept_key = jax.random.split(key)
    candidate = moves.propose_jump(draw_key, target, mixture)
    return moves.jump(jax.random.uniform(accept_key), point, candidate)


def one_change(key, point, target, mixture, prior_share=0.3):
    noise = draw_noise(key, target.dim, mixture.degrees_of_freedom)
    proposal = moves.propose_change(noise, point, target, mixture, prior_share)
    return moves.decide(noise.choice[3], point, target, mixture, proposal)


def one_walk(key, point, target, mixture, step_size=0.8):
    noise = draw_noise(key, target.dim, mixture.degrees_of_freedom)
    size = jnp.asarray(step_size)
    proposal = moves.propose_walk(noise, point, target, mixture, size)
    return moves.decide(noise.choice[3], point, target, mixture, proposal)


def one_leap(key, point, target, mixture):
    return moves.leap(key, point, target, mixture, jnp.asarray(0.7), 3)


MOVES = {
    "jump": one_jump,
    "change": one_change,
    "change from the prior": partial(one_change, prior_share=1.0),
    "change from the mixture": partial(one_change, prior_share=0.02),
    "walk": one_walk,
    "leap": one_leap,
}


def scores_after(move, target, mixture, probability, means, covariances, num=6000):
    """Start exactly from the target, move five times, and compare with the target.

    Chains are independent, so standard errors are those of independent draws.
    """
    structure, z = sample_exactly(7, num, probability, means, covariances)

    @jax.jit
    @jax.vmap
    def run(key, structure, z):
        point = moves.evaluate(target, mixture, structure, z)

        def iterate(point, key):
            return move(key, point, target, mixture)

        return jax.lax.scan(iterate, point, jax.random.split(key, 5))

    point, info = run(
        jax.random.split(jax.random.key(11), num),
        jnp.asarray(structure),
        jnp.asarray(z, float),
    )
    after, z = np.asarray(point.structure), np.asarray(point.z)
    values = []
    for index, expected in enumerate(probability):
        here = after == index
        assert np.all(z[here][:, ~in_use(index)] == 0.0)
        values.append(here - expected)
        whitener = np.linalg.inv(np.linalg.cholesky(covariances[index]))
        white = (z[:, in_use(index)] - means[index]) @ whitener.T
        for row in white.T:
            values += [here * row, here * (row**2 - 1.0)]
    values = np.array(values)
    scores = values.mean(axis=1) / (values.std(axis=1) / np.sqrt(num))
    return scores, info


@pytest.mark.slow
@pytest.mark.parametrize("name", MOVES)
def test_each_move_alone_leaves_the_target_invariant(name):
    case = linear_case()
    scores, info = scores_after(MOVES[name], *case)
    assert np.max(np.abs(scores)) < two_sided(FALSE_ALARM, scores.size)
    accepted, changed = np.asarray(info.accepted), np.asarray(info.changes_structure)
    # Proposals must be taken often enough for the test to mean something.
    assert accepted.mean() > 0.1
    if name in ("walk", "leap"):
        assert not changed.any()
        # An always accepted move would hide a wrong ratio.
        assert np.asarray(info.accept_probability).mean() < 0.999
    else:
        assert np.mean(accepted & changed) > 0.1


@pytest.mark.slow
def test_short_walks_about_the_posterior_are_nearly_always_accepted():
    target, design, data = make_problem()
    _, probability, means, covariances = closed_form(design, data)
    mixture = skewed_mixture(target, means, covariances, shift=0.0, widening=1.0)
    small = partial(one_walk, step_size=0.05)
    _, info = scores_after(
        small, target, mixture, probability, means, covariances, num=500
    )
    assert np.asarray(info.accept_probability).mean() > 0.97


@pytest.mark.slow
def test_prior_only_run_returns_the_prior():
    """Structure frequencies and marginals, from a deliberately skewed mixture."""
    target = make_target(NoLikelihood(), ANGLES)
    rng = np.random.default_rng(0)
    num, dim = len(PRIOR), SLOT.size
    factor = np.eye(dim) + np.tril(0.3 * rng.normal(size=(num, dim, dim)), -1)
    factor *= rng.uniform(0.5, 1.0, size=(num, dim, 1))
    mixture = make_mixture(
        target,
        jnp.arange(num),
        jnp.asarray(0.5 * rng.normal(size=(num, dim))),
        jnp.asarray(factor),
        jnp.asarray(np.linspace(-1.0, 1.0, num)),
    )
    mixture = eqx.filter_jit(add_slot_components)(target, mixture, total_weight=0.3)
    mixture = eqx.filter_jit(add_prior_components)(target, mixture, total_weight=0.1)
    draws, _ = run_chains(
        jax.random.key(3),
        target,
        mixture,
        num_chains=8,
        num_warmup=50,
        num_samples=2000,
    )
    structure, z = np.asarray(draws.structure), np.asarray(draws.z)
    assert np.all(np.abs(z) <= np.where(ANGLES > 0, ANGLES / 2, np.inf))
    used = np.array([in_use(index) for index in range(num)])[structure]
    np.testing.assert_array_equal(z == 0.0, ~used)
    values = [(structure == index) - PRIOR[index] for index in range(num)]
    for index in range(dim):
        here = used[..., index]
        if ANGLES[index] > 0:
            for turn in (np.cos, np.sin):
                for harmonic in (1, 2):
                    wave = turn(2 * np.pi * harmonic * z[..., index] / ANGLES[index])
                    values.append(here * wave)
        else:
            values += [here * z[..., index], here * (z[..., index] ** 2 - 1.0)]
    scores = np.array(
        [
            value.mean() / (value.std() / np.sqrt(effective_sample_size(value)))
            for value in values
        ]
    )
    assert np.max(np.abs(scores)) < two_sided(FALSE_ALARM, scores.size)


class TwoHeadings(eqx.Module):
    """An angle that two opposite headings explain, the second three times as well."""

    sharpness: jax.Array

    def __call__(self, z, active):
        lobe = self.sharpness * (jnp.cos(jnp.pi * z[0]) - 1.0)
        other = self.sharpness * (-jnp.cos(jnp.pi * z[0]) - 1.0)
        bimodal = jnp.logaddexp(lobe, other + jnp.log(3.0))
        return jnp.where(active[0], bimodal, jnp.log(0.2))


@pytest.mark.slow
def test_bimodal_angle_is_shared_out_rightly():
    """Both lobes of a von Mises mixture, one of them across the period's seam."""
    target = StructureTarget(
        log_likelihood=TwoHeadings(jnp.asarray(8.0)),
        structures=jnp.asarray([[False], [True]]),
        log_prior=jnp.log(jnp.asarray([0.4, 0.6])),
        slot=jnp.asarray([0], jnp.int32),
        period=jnp.asarray([2.0]),
    )
    mixture = make_mixture(
        target,
        jnp.asarray([0, 1, 1]),
        jnp.asarray([[0.0], [0.0], [0.97]]),
        jnp.full((3, 1, 1), 0.15),
        jnp.zeros(3),
    )
    draws, _ = run_chains(
        jax.random.key(0),
        target,
        mixture,
        num_chains=4,
        num_warmup=50,
        num_samples=3000,
    )
    structure, z = np.asarray(draws.structure), np.asarray(draws.z)[..., 0]
    lobe = 4.0 * np.exp(-8.0) * np.i0(8.0)
    joint = np.array([0.4 * 0.2, 0.6 * lobe])
    probability = joint[1] / joint.sum()
    variance = stats.vonmises(8.0).var()
    here = structure == 1
    is_seam = np.abs(z) > 0.5
    spread = np.pi * (np.abs(z) - np.where(is_seam, 1.0, 0.0))
    values = [
        here - probability,
        here * (is_seam - 0.75),
        here * (spread**2 - variance),
    ]
    for value in values:
        error = value.std() / np.sqrt(effective_sample_size(value))
        assert abs(value.mean()) < two_sided(FALSE_ALARM, len(values)) * error


@pytest.mark.slow
def test_run_chains_makes_the_same_moves_as_single_steps():
    target, mixture, *_ = linear_case()
    settings = ChainSettings()
    key = jax.random.key(2)
    draws, info = run_chains(key, target, mixture, **RUN)
    init_key, run_key = jax.random.split(key)
    num_chains, num_warmup = RUN["num_chains"], RUN["num_warmup"]
    num_steps = num_warmup + RUN["num_samples"]
    keys = jax.random.split(run_key, (num_steps, num_chains))
    chain = 1
    init_key = jax.random.split(init_key, num_chains)[chain]
    state = jax.jit(init)(init_key, target, mixture)
    one_step = jax.jit(step)
    for index in range(num_warmup + 10):
        is_adapting = jnp.asarray(index < num_warmup)
        state, _ = one_step(
            keys[index, chain], state, target, mixture, is_adapting=is_adapting
        )
        if index >= num_warmup:
            kept = index - num_warmup
            assert state.point.structure == draws.structure[chain, kept]
            np.testing.assert_allclose(state.point.z, draws.z[chain, kept], atol=1e-9)
    assert proposal_keys(key, settings).shape == (settings.num_jumps,)
    per_step = settings.num_jumps + settings.num_changes + settings.num_walks
    np.testing.assert_array_equal(
        info.proposed.sum(axis=(1, 2)), per_step * RUN["num_samples"]
    )


@pytest.mark.slow
def test_same_key_gives_same_bits():
    target, mixture, *_ = linear_case()
    first, _ = run_chains(jax.random.key(2), target, mixture, **RUN)
    again, _ = run_chains(jax.random.key(2), target, mixture, **RUN)
    other, _ = run_chains(jax.random.key(4), target, mixture, **RUN)
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert not np.array_equal(first.z, other.z)


@pytest.mark.slow
def test_a_likelihood_that_fails_is_never_visited():
    class Failing(eqx.Module):
        def __call__(self, z, active):
            return jnp.where(z[0] > 0.5, jnp.nan, jnp.where(z[0] < -0.5, jnp.inf, 0.0))

    target = make_target(Failing())
    mixture = linear_case()[1]

    @jax.jit
    @jax.vmap
    def run(key):
        start = moves.evaluate(target, mixture, jnp.asarray(0), jnp.zeros(SLOT.size))

        def iterate(point, key):
            for move in (one_jump, one_leap):
                key, move_key = jax.random.split(key)
                point, _ = move(move_key, point, target, mixture)
            return point, point

        return jax.lax.scan(iterate, start, jax.random.split(key, 20))[1]

    points = run(jax.random.split(jax.random.key(0), 50))
    assert np.all(np.abs(points.z[..., 0]) <= 0.5)
    assert np.all(np.isfinite(points.log_density))
    assert np.std(points.z[:, -1, 0]) > 0.1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_jumps": -1}, "num_jumps"),
        ({"num_starts": 0}, "num_starts"),
        ({"prior_share": 0.0}, "prior_share"),
    ],
)
def test_settings_that_cannot_run_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ChainSettings(**options)


def test_dual_averaging_finds_the_step_of_a_known_response():
    """Acceptance exp(-step) is one half at a step of log 2."""
    state = start_dual_averaging(0.1)
    for _ in range(400):
        probability = jnp.exp(-state.step_size(True))
        state = update_dual_averaging(state, probability, 0.5, 4.0)
    np.testing.assert_allclose(state.step_size(False), np.log(2.0), rtol=0.02)


@pytest.mark.slow
def test_diagnostics_pass_good_chains_and_name_bad_ones():
    target, mixture, *_ = linear_case()
    draws, info = run_chains(jax.random.key(0), target, mixture, **RUN)
    good = diagnose_chains(target, draws, info, scalars={"first": draws.z[..., 0]})
    assert good.ok
    assert good.reasons == []
    assert {"log_density", "slot_0", "first", "z_0"} <= good.r_hat.keys()
    assert 0.2 < good.acceptance["jump_structure"] <= 1.0
    shifted = draws._replace(log_density=draws.log_density.at[0].set(-50.0))
    bad = diagnose_chains(target, shifted)
    assert not bad.ok
    assert any("log_density: R-hat" in reason for reason in bad.reasons)
    assert any("chains [0] never moved" in reason for reason in bad.reasons)
    broken = draws._replace(log_density=draws.log_density.at[1, 3].set(jnp.nan))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert "not finite" in diagnose_chains(target, broken).reasons[0]


def test_structures_reach_each_other_by_changes_both_ways():
    target = make_target(NoLikelihood())
    near = np.array(
        [
            moves.neighbours(target, jnp.asarray(index))
            for index in range(len(STRUCTURES))
        ]
    )
    np.testing.assert_array_equal(near, near.T)
    for a in range(len(STRUCTURES)):
        for b in range(len(STRUCTURES)):
            born = np.sum(STRUCTURES[b] & ~STRUCTURES[a])
            dead = np.sum(STRUCTURES[a] & ~STRUCTURES[b])
            assert near[a, b] == ((born, dead) in [(1, 0), (0, 1), (1, 1)])
