"""Densities of the mixture against SciPy, and draws against densities."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from boomdp_jax.core.random_numbers import draw_noise, pick
from boomdp_jax.inference.samplers.laplace_mixture import make_mixture
from boomdp_jax.inference.samplers.mixture_building import (
    add_prior_components,
    add_slot_components,
    laplace_mixture,
)
from boomdp_jax.inference.samplers.slot_conditional import sample_slot, slot_log_density
from tests.inference.linear_gaussian import (
    PRIOR,
    SLOT,
    STRUCTURES,
    NoLikelihood,
    in_use,
    make_target,
    two_sided,
)

FREEDOM = 6
ANGLES = np.array([0.0, 2.0, 0.0, 3.0, 0.0])
FALSE_ALARM = 1e-4


def random_mixture(target, seed=0, from_prior=None, num_each=2):
    """Components of every structure with full covariances."""
    rng = np.random.default_rng(seed)
    structure = np.repeat(np.arange(len(STRUCTURES)), num_each)
    num, dim = structure.size, SLOT.size
    factor = np.tril(0.3 * rng.normal(size=(num, dim, dim)), -1)
    factor += np.eye(dim) * np.exp(0.2 * rng.normal(size=(num, 1, dim))) * 0.5
    mixture = make_mixture(
        target,
        jnp.asarray(structure, jnp.int32),
        jnp.asarray(0.4 * rng.normal(size=(num, dim)), float),
        jnp.asarray(factor, float),
        jnp.asarray(rng.normal(size=num), float),
        from_prior=from_prior,
        degrees_of_freedom=FREEDOM,
    )
    return mixture


def student(mixture, component, coordinates):
    """SciPy's density of some coordinates of a component."""
    mean = np.asarray(mixture.mean[component])[coordinates]
    factor = np.asarray(mixture.scale_tril[component])
    shape = (factor @ factor.T)[np.ix_(coordinates, coordinates)]
    return stats.multivariate_t(mean, shape, df=FREEDOM)


@pytest.mark.slow
def test_components_of_other_structures_change_nothing():
    """Nor does it matter in which order they come, and how much room there is."""
    target = make_target(two_sided)
    whole = random_mixture(target, num_each=3)
    order = np.random.default_rng(5).permutation(whole.num_components)
    weight = np.array(whole.log_weight)[order]
    weight[::7] = -np.inf
    parts = (whole.structure[order], whole.mean[order], whole.scale_tril[order])

    def made(**more):
        mixture = make_mixture(
            target, *parts, jnp.asarray(weight), degrees_of_freedom=FREEDOM, **more
        )
        return add_prior_components(target, add_slot_components(target, mixture))

    plain, sorted_ = made(), made(most_each=3)
    assert plain.members is None
    assert sorted_.members.shape == (len(STRUCTURES), 3 + STRUCTURES.shape[1] + 1)
    rows = np.asarray(sorted_.members)
    seen = np.sort(rows[rows >= 0])
    expected = np.flatnonzero(np.asarray(sorted_.log_weight) > -np.inf)
    np.testing.assert_array_equal(seen, expected)
    own = np.asarray(sorted_.structure)[rows] == np.arange(len(rows))[:, None]
    assert np.all(own[rows >= 0])

    @eqx.filter_jit
    def values(mixture, k, z, block):
        noise = draw_noise(jax.random.key(0), SLOT.size, FREEDOM)
        return (
            mixture.log_density(target, k, z),
            slot_log_density(target, mixture, k, z, block, 0.2),
            sample_slot(noise, target, mixture, k, z, block, 0.2)[0],
        )

    rng = np.random.default_rng(6)
    for k in range(len(STRUCTURES)):
        z = jnp.asarray(np.where(in_use(k), rng.normal(size=SLOT.size), 0.0))
        slot = SLOT[in_use(k)][-1] if in_use(k).any() else 0
        block = jnp.asarray((SLOT == slot) & in_use(k))
        arguments = (jnp.asarray(k), z, block)
        for a, b in zip(
            values(plain, *arguments), values(sorted_, *arguments), strict=True
        ):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_log_density_is_a_mixture_of_student_densities(precision):
    target = make_target(NoLikelihood())
    mixture = random_mixture(target)
    rng = np.random.default_rng(1)
    worst = 0.0
    for structure in range(len(STRUCTURES)):
        used = np.flatnonzero(in_use(structure))
        z = np.where(in_use(structure), rng.normal(size=SLOT.size), 0.0)
        expected = np.logaddexp.reduce(
            [
                float(mixture.log_weight[c]) + student(mixture, c, used).logpdf(z[used])
                for c in np.flatnonzero(np.asarray(mixture.structure) == structure)
            ]
        )
        found = mixture.log_density(
            target, jnp.asarray(structure), jnp.asarray(z, float)
        )
        worst = max(worst, abs(float(found) - expected))
    assert worst < precision.choose(single=2e-5, double=1e-11)


@pytest.mark.slow
def test_conditional_of_a_slot_is_joint_over_marginal(precision):
    target = make_target(NoLikelihood())
    mixture = random_mixture(target, num_each=1)
    rng = np.random.default_rng(2)
    worst = 0.0
    for structure in range(len(STRUCTURES)):
        for slot in np.flatnonzero(STRUCTURES[structure]):
            used = np.flatnonzero(in_use(structure))
            kept = used[SLOT[used] != slot]
            z = np.where(in_use(structure), rng.normal(size=SLOT.size), 0.0)
            expected = student(mixture, structure, used).logpdf(z[used]) - student(
                mixture, structure, kept
            ).logpdf(z[kept])
            found = slot_log_density(
                target,
                mixture,
                jnp.asarray(structure),
                jnp.asarray(z, float),
                jnp.asarray(SLOT == slot),
                1e-30,
            )
            worst = max(worst, abs(float(found) - expected))
    assert worst < precision.choose(single=2e-5, double=1e-11)


@pytest.mark.slow
def test_conditional_weighs_components_by_what_is_kept():
    target = make_target(NoLikelihood())
    mixture = random_mixture(target, num_each=3)
    structure, slot = 4, 1
    used = np.flatnonzero(in_use(structure))
    kept = used[SLOT[used] != slot]
    z = np.where(in_use(structure), [0.3, -0.2, 0.8, -0.5, 0.0], 0.0)
    members = np.flatnonzero(np.asarray(mixture.structure) == structure)
    joint, marginal = (
        np.logaddexp.reduce(
            [
                float(mixture.log_weight[c]) + student(mixture, c, of).logpdf(z[of])
                for c in members
            ]
        )
        for of in (used, kept)
    )
    block = jnp.asarray(SLOT == slot)
    prior = np.sum(stats.norm.logpdf(z[SLOT == slot]))
    found = slot_log_density(
        target, mixture, jnp.asarray(structure), jnp.asarray(z), block, 0.25
    )
    expected = np.logaddexp(np.log(0.75) + joint - marginal, np.log(0.25) + prior)
    np.testing.assert_allclose(float(found), expected, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("has_prior_part", [False, True])
def test_draws_follow_the_density_with_angles(has_prior_part):
    """Averages of f(x) p(x) / q(x) over draws from q are prior expectations of f."""
    target = make_target(NoLikelihood(), ANGLES)
    from_prior = None
    if has_prior_part:
        from_prior = jnp.asarray(np.random.default_rng(5).random((12, SLOT.size)) < 0.4)
    mixture = random_mixture(target, from_prior=from_prior)
    keys = jax.random.split(jax.random.key(3), 40_000)

    @jax.jit
    @jax.vmap
    def draw(key):
        drawn = mixture.sample(key, target)
        ratio = target.log_prior_density(drawn.structure, drawn.z)
        ratio -= mixture.log_density(target, drawn.structure, drawn.z)
        return drawn, jnp.where(drawn.is_inside, jnp.exp(ratio), 0.0)

    drawn, weight = jax.tree.map(np.asarray, draw(keys))
    period = np.where(ANGLES > 0, ANGLES, np.inf)
    assert np.all(np.abs(drawn.z) <= period / 2)
    scores = []
    for structure in range(len(PRIOR)):
        here = drawn.structure == structure
        assert np.all(drawn.z[here][:, ~in_use(structure)] == 0.0)
        functions = []
        for coordinate in np.flatnonzero(in_use(structure)):
            z, size = drawn.z[:, coordinate], ANGLES[coordinate]
            if size > 0:
                functions.append(np.cos(2 * np.pi * z / size))
                functions.append(np.sin(2 * np.pi * z / size))
            else:
                functions.append(np.tanh(z))
        values = [weight * here - PRIOR[structure]]
        values += [weight * here * function for function in functions]
        scores += [np.mean(v) / (np.std(v) / np.sqrt(v.size)) for v in values]
    assert np.max(np.abs(scores)) < two_sided(FALSE_ALARM, len(scores))


@pytest.mark.slow
@pytest.mark.parametrize("prior_share", [1e-30, 0.3])
def test_slot_draws_follow_their_density(prior_share):
    target = make_target(NoLikelihood(), ANGLES)
    mixture = random_mixture(target, num_each=2)
    structure, block = jnp.asarray(4), jnp.asarray(SLOT == 1)
    kept = jnp.asarray([0.4, -0.3, 0.0, 0.0, 0.0])

    @jax.jit
    @jax.vmap
    def draw(key):
        noise = draw_noise(key, target.dim, FREEDOM)
        z, is_inside = sample_slot(
            noise, target, mixture, structure, kept, block, prior_share
        )
        log_density = slot_log_density(
            target, mixture, structure, z, block, prior_share
        )
        prior = target.log_prior_density(structure, z)
        prior -= target.log_prior_density(jnp.asarray(1), kept)
        prior -= target.log_prior[4] - target.log_prior[1]
        return z, jnp.where(is_inside, jnp.exp(prior - log_density), 0.0)

    z, weight = jax.tree.map(
        np.asarray, draw(jax.random.split(jax.random.key(0), 20_000))
    )
    np.testing.assert_array_equal(
        z[:, SLOT != 1], np.tile(kept, (len(z), 1))[:, SLOT != 1]
    )
    values = np.stack(
        [
            weight - 1.0,
            weight * np.tanh(z[:, 2]),
            weight * np.sin(2 * np.pi * z[:, 3] / ANGLES[3]),
            weight * np.cos(2 * np.pi * z[:, 3] / ANGLES[3]),
        ]
    )
    scores = values.mean(axis=1) / (values.std(axis=1) / np.sqrt(len(z)))
    assert np.max(np.abs(scores)) < two_sided(FALSE_ALARM, scores.size)


def test_a_slot_without_components_is_drawn_from_the_prior():
    target = make_target(NoLikelihood())
    mixture = random_mixture(target)
    mixture = eqx.tree_at(
        lambda m: m.log_weight,
        mixture,
        jnp.where(mixture.structure == 4, -jnp.inf, mixture.log_weight),
    )
    z = jnp.asarray([0.1, 0.2, 1.1, -0.4, 0.0])
    found = slot_log_density(
        target, mixture, jnp.asarray(4), z, jnp.asarray(SLOT == 1), 0.2
    )
    expected = stats.norm.logpdf([1.1, -0.4]).sum()
    np.testing.assert_allclose(float(found), expected, rtol=1e-12)


@pytest.mark.slow
def test_slot_components_join_a_smaller_mode_with_the_prior():
    target = make_target(NoLikelihood())
    mixture = random_mixture(target, num_each=1)
    grown = eqx.filter_jit(add_slot_components)(target, mixture, total_weight=0.4)
    before = np.exp(mixture.structure_log_weight(target))
    after = np.exp(grown.structure_log_weight(target))
    np.testing.assert_allclose(after, before, rtol=1e-12)
    new = slice(mixture.num_components, None)
    weight = np.exp(np.asarray(grown.log_weight))[new]
    structure = np.asarray(grown.structure)[new]
    is_real = weight > 0
    # Structures 1, 2, 3 grow from 0; 4 from 1 and from 2; 5 from 1 and from 3.
    assert sorted(structure[is_real]) == [1, 2, 3, 4, 4, 5, 5]
    for index in range(1, len(PRIOR)):
        share = weight[is_real & (structure == index)].sum() / before[index]
        np.testing.assert_allclose(share, 0.4, rtol=1e-12)
    z = np.array([0.2, -0.3, 0.6, 0.1, 0.0])
    kept, block = np.array([0, 1]), np.array([2, 3])
    expected = student(mixture, 1, kept).logpdf(z[kept]) + np.sum(
        stats.norm.logpdf(z[block])
    )
    each = grown.component_log_density(target, jnp.asarray(4), jnp.asarray(z))
    each = np.asarray(each - grown.log_weight)[new][is_real & (structure == 4)]
    assert np.min(np.abs(each - expected)) < 1e-11


def test_prior_components_reach_every_structure():
    target = make_target(NoLikelihood())
    mixture = random_mixture(target, num_each=1)
    log_weight = mixture.log_weight.at[3].set(-jnp.inf)
    log_weight -= jax.nn.logsumexp(log_weight)
    mixture = eqx.tree_at(lambda m: m.log_weight, mixture, log_weight)
    grown = add_prior_components(target, mixture, total_weight=0.12)
    weight = np.exp(grown.structure_log_weight(target))
    np.testing.assert_allclose(weight[3], 0.12 / len(PRIOR), rtol=1e-12)
    np.testing.assert_allclose(weight.sum(), 1.0, rtol=1e-12)


def test_a_mode_without_curvature_is_dropped_and_an_open_angle_keeps_its_width():
    target = make_target(NoLikelihood(), ANGLES)
    precision = np.stack([np.diag([1.0, 0.0, 1.0, 0.0, 1.0])] * 3)
    precision[1, 0, 0] = -2.0
    mixture = eqx.filter_jit(laplace_mixture)(
        target,
        jnp.asarray([1, 0, 0]),
        jnp.zeros((3, SLOT.size)),
        jnp.asarray(precision),
        jnp.asarray([0.0, 0.0, -jnp.inf]),
    )
    np.testing.assert_allclose(np.exp(mixture.log_weight), [1.0, 0.0, 0.0])
    np.testing.assert_allclose(
        mixture.scale_tril[0, 1, 1], ANGLES[1] / np.sqrt(12.0), rtol=1e-12
    )
    assert np.all(np.isfinite(mixture.whitening))


def test_laplace_factor_survives_six_decades_in_single_precision():
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(SLOT.size, SLOT.size)))[0]
    correlation = basis @ np.diag([1.0, 2.0, 3.0, 5.0, 8.0]) @ basis.T
    scale = np.array([1e-5, 1.0, 1e-3, 10.0, 1e-2])
    precision = correlation / np.outer(scale, scale)
    with jax.enable_x64(False):
        target = make_target(NoLikelihood())
        target = eqx.tree_at(
            lambda t: t.structures, target, jnp.ones_like(target.structures)
        )
        mixture = eqx.filter_jit(laplace_mixture)(
            target,
            jnp.zeros(1, jnp.int32),
            jnp.zeros((1, SLOT.size)),
            jnp.asarray(precision, jnp.float32)[None],
            jnp.zeros(1),
        )
        factor = np.asarray(mixture.scale_tril[0], float)
    found = factor @ factor.T / np.outer(scale, scale)
    np.testing.assert_allclose(found, np.linalg.inv(correlation), atol=1e-5)


def test_batched_mixtures_equal_single_ones():
    target = make_target(NoLikelihood())
    mixtures = [random_mixture(target, seed) for seed in range(3)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *mixtures)
    keys = jax.random.split(jax.random.key(0), 3)

    @jax.jit
    def draw(key, mixture):
        drawn = mixture.sample(key, target)
        return drawn, mixture.log_density(target, drawn.structure, drawn.z)

    together = jax.jit(jax.vmap(draw))(keys, stacked)
    for index, mixture in enumerate(mixtures):
        alone = draw(keys[index], mixture)
        jax.tree.map(
            lambda a, b, index=index: np.testing.assert_allclose(
                a, b[index], rtol=1e-10, atol=1e-12
            ),
            alone,
            together,
        )


def test_pick_never_chooses_an_option_of_no_weight():
    log_weight = jnp.asarray([-jnp.inf, 2.0, -jnp.inf, 1.0, -jnp.inf])
    uniform = jnp.linspace(1e-9, 1.0 - 1e-9, 2001)
    index = np.asarray(jax.vmap(lambda u: pick(log_weight, u))(uniform))
    assert set(index) == {1, 3}
    share = np.exp(2.0) / (np.exp(2.0) + np.exp(1.0))
    np.testing.assert_allclose(np.mean(index == 1), share, atol=1e-3)
