"""No product of matrices is left to what GPUs do by default, but those of networks."""

import functools
from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax import models, planning
from boomdp_jax.core import make_history
from boomdp_jax.core.random_numbers import draw_noise
from boomdp_jax.inference.blocks.block import make_block
from boomdp_jax.inference.fits.fit import Modes
from boomdp_jax.inference.fits.seeds import seed_coordinates
from boomdp_jax.inference.hypotheses.prior import NOISE_GROUPS
from boomdp_jax.inference.likelihoods.filter_density import filter_density
from boomdp_jax.inference.likelihoods.kalman import extended_filter
from boomdp_jax.inference.likelihoods.one_step import OneStepLikelihood
from boomdp_jax.inference.likelihoods.tracking import innovations
from boomdp_jax.inference.online import moves as online_moves
from boomdp_jax.inference.pushes.reading_law import (
    ReadingLaw,
    law_after,
    log_likelihood,
)
from boomdp_jax.inference.readings.track_data import track_data
from boomdp_jax.inference.samplers import moves
from boomdp_jax.inference.samplers.slot_conditional import sample_slot, slot_log_density
from boomdp_jax.inference.under_numpyro import nuts_chains, svi
from boomdp_jax.inference.under_numpyro.numpyro_model import make_model
from boomdp_jax.interop.continuous_actions import ContinuousActions
from boomdp_jax.physics import quantities, rollout, separation
from boomdp_jax.planning.belief import mean_hypothesis
from tests.inference.likelihoods.test_filter_density import level, two_bodies
from tests.inference.linear_gaussian import SLOT, NoLikelihood, make_target
from tests.inference.online.test_parts import particle_set
from tests.inference.recordings import box_scene, free_box
from tests.inference.samplers.test_laplace_mixture import random_mixture
from tests.models.worlds import cart
from tests.physics.contact_scenes import FLOOR, body, spec_of
from tests.products import check, products

KEY = jax.random.key(0)


@pytest.fixture(autouse=True)
def _single_precision() -> Iterator[None]:
    """As GPUs are used."""
    with jax.enable_x64(False):
        yield


def small_world():
    """A box on a wheel that is pinned to a disc, above a floor."""
    pin = {"type": "revolute", "a": "box", "b": "disc", "anchor_a": [0.2, 0.0]}
    wheel = {"type": "wheel", "a": "box", "pose": [-0.1, 0.0, 0.0]}
    return spec_of(
        body("box", (0.2, 0.1), (0.0, 0.2, 0.0)),
        body("disc", 0.1, (0.4, 0.2, 0.0)),
        FLOOR,
        constraints=[
            pin | {"anchor_b": [-0.2, 0.0]},
            wheel | {"viscous": [1.0, 10.0]},
        ],
    )


def last_pose(scene, params, state, wrench):
    state, _ = rollout(scene, params, state, wrench)
    return jnp.sum(state.pose)


def test_physics_has_products_only_where_it_is_measured():
    spec = small_world()
    scene, params, state = spec.scene, spec.params(), spec.initial_state()
    assert not products(last_pose, scene, params, state, jnp.zeros((2, 3, 3)))
    check(separation, scene, state)
    check(quantities.total_energy, scene, params, state)
    check(quantities.linear_momentum, scene, params, state)


def test_derivatives_of_a_lone_body_have_no_products():
    spec = cart()
    scene, params, state = spec.scene, spec.params(), spec.initial_state()
    slope = jax.grad(last_pose, (1, 3), allow_int=True)
    assert not products(slope, scene, params, state, jnp.zeros((2, 1, 3)))


@pytest.mark.slow
def test_derivatives_of_a_contact_have_no_products():
    spec = spec_of(body("a", 0.1, (0.0, 0.0, 0.0)), body("b", 0.1, (0.2, 0.0, 0.0)))
    scene, params, state = spec.scene, spec.params(), spec.initial_state()
    slope = jax.grad(last_pose, (1, 3), allow_int=True)
    assert not products(slope, scene, params, state, jnp.zeros((2, 2, 3)))


def readings_of_box():
    return free_box(np.random.default_rng(0), 4)


def pinned_pair(**options):
    """Two boxes with a pin between them, and readings of both."""
    pin = {"type": "revolute", "a": "a", "b": "b"}
    pin |= {"anchor_a": [0.2, 0.0], "anchor_b": [-0.2, 0.0]}
    spec = two_bodies([pin])
    readings = 0.1 * np.random.default_rng(0).normal(size=(5, 2, 6))
    history = make_history(readings[:-1], np.zeros((4, 2, 3)), readings[1:], 0.02)
    return spec, track_data(history, (0, 1), True, **options)


@pytest.mark.parametrize("freedom", [None, 4.0], ids=["normal", "student"])
def test_products_of_filters_have_all_bits(freedom):
    spec, data = pinned_pair(freedom=freedom)
    arguments = spec.scene, spec.params(), data, level(2)
    check(extended_filter, *arguments)
    assert all(is_full for is_full, _ in products(filter_density, *arguments))


def test_products_of_likelihoods_and_first_guesses_have_all_bits():
    spec, data = pinned_pair()
    scene, params = spec.scene, spec.params()
    gains = jax.eval_shape(extended_filter, scene, params, data, level(2)).gains
    gains = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), gains)
    assert not products(innovations, scene, params, data, gains)
    block = make_block(box_scene({"revolute": 1, "wheel": 1}), (0,), readings_of_box())
    tracked = block.target.log_likelihood
    single = OneStepLikelihood(tracked.coordinates, tracked.data.steps)
    z, active = jnp.zeros(block.layout.dim), block.target.structures[-1]
    assert not products(jax.value_and_grad(lambda z: single(z, active)), z)
    check(seed_coordinates, tracked.coordinates, tracked.data.steps)


def test_products_of_expected_readings_have_all_bits():
    spec = small_world()
    params = jax.tree.map(lambda leaf: leaf[None], spec.params())
    noise, wrench = jnp.ones((1, 3, 4)), jnp.zeros((3, 3))
    arguments = noise, noise[..., :2], spec.initial_state(), wrench, jnp.ones((2, 3, 3))
    after = functools.partial(law_after, spec.scene, params, bodies=(0, 1))
    assert not products(after, *arguments)
    law = ReadingLaw(jnp.zeros((1, 6)), jnp.eye(6)[None], jnp.ones((1, 6)), None)
    check(log_likelihood, law, jnp.zeros((1, 6)))


def test_products_of_mixtures_and_moves_have_all_bits():
    target = make_target(NoLikelihood())
    check(random_mixture, target)
    mixture = random_mixture(target)
    structure, z = jnp.asarray(4), jnp.ones(5)
    block = jnp.asarray(SLOT == 1)
    noise = draw_noise(KEY, 5, mixture.degrees_of_freedom)
    check(mixture.sample, KEY, target)
    check(jax.value_and_grad(lambda z: mixture.log_density(target, structure, z)), z)
    check(sample_slot, noise, target, mixture, structure, z, block, 0.5)
    check(slot_log_density, target, mixture, structure, z, block, 0.5)
    number = jnp.zeros(())
    point = moves.Point(structure, z, number, number)
    check(moves.propose_jump, KEY, target, mixture)
    check(moves.propose_change, noise, point, target, mixture, 0.5)
    check(moves.propose_walk, noise, point, target, mixture, number)
    check(moves.leap, KEY, point, target, mixture, number, 2)


def test_products_of_fits_to_particles_have_all_bits():
    target = make_target(NoLikelihood())
    particles = particle_set(np.zeros(4), np.zeros((4, 5)), np.zeros(4))
    check(online_moves._moments, target, particles, jnp.ones(4), jnp.asarray(0))


@pytest.mark.slow
def test_products_of_numpyros_samplers_have_all_bits():
    spec = box_scene({"revolute": 1})
    model = make_model(spec, readings_of_box(), {"box": ["revolute"]})
    point = {site.name: jnp.zeros(site.loc.shape) for site in model.sites[0]}
    point |= {f"noise.{group}": jnp.zeros(1) for group in NOISE_GROUPS}
    covariance = jnp.eye(sum(leaf.size for leaf in point.values()))
    chains = nuts_chains._Chains(model, 2)
    (begin,), (advance,) = chains._begin._stages, chains._advance._stages
    shared, words = (chains._arrays, covariance), jax.random.key_data(KEY)
    check(begin.__wrapped__, shared, words, point)
    state = eqx.filter_eval_shape(begin.__wrapped__, shared, words, point)
    check(advance.__wrapped__, shared, state)
    (block,) = model.blocks
    dim = block.layout.dim
    mode = Modes(
        jnp.zeros(1, int), jnp.zeros((1, dim)), jnp.eye(dim)[None], jnp.zeros(1)
    )
    check(nuts_chains._pooled, jnp.ones((2, 3, 2)), jnp.eye(2))
    check(nuts_chains._start_at, KEY, model, mode, 2)
    check(svi._fit, KEY, KEY, model, point, covariance, 2, 2)


REGRESSORS = {
    "linear": models.LinearRegression(capacity=6),
    "locally weighted": models.LocallyWeighted(capacity=6, num_held_out=3),
    "process": models.GaussianProcess(
        capacity=6, num_tuning_rows=4, num_tuning_steps=2, is_noisy=True
    ),
}


def check_model(spec, make) -> None:
    """Learning, drawing a hypothesis and predicting with it, in one program."""
    model, state = make(spec.scene), spec.initial_state()
    wrench = jnp.zeros((spec.num_bodies, 3))

    def learn_and_tell(key):
        learnt = model.update(model.init(key), state, wrench, state)
        return model.transition(key, model.sample(key, learnt, 1)[0], state, wrench)

    check(learn_and_tell, KEY)


@pytest.mark.parametrize("name", REGRESSORS)
def test_products_of_regressions_have_all_bits(name):
    check_model(cart(), lambda scene: models.BodyRegression(scene, REGRESSORS[name]))


def test_products_of_regressions_of_objects_have_all_bits():
    regressor = REGRESSORS["locally weighted"]
    check_model(
        cart(walls=True),
        lambda scene: models.ObjectOriented(scene, regressor, radius=0.2),
    )


@pytest.mark.parametrize(
    "search",
    [
        models.GaussNewton(num_starts=2, num_steps=2),
        models.CmaEs(num_generations=2, population=4),
    ],
    ids=["derivatives", "draws"],
)
def test_products_of_point_fits_have_all_bits(search):
    check_model(cart(), lambda scene: models.PointFit(scene, search, capacity=4))


def test_products_of_planners_have_all_bits():
    actions = jnp.array([[-1.0, -1.0], [1.0, 1.0]])
    belief = planning.Belief(jnp.ones((3, 2)), jnp.zeros(3))
    check(mean_hypothesis, belief)

    def plan(key, leaf_fn=None):
        return planning.mppi(
            key,
            belief,
            jnp.zeros(2),
            transition_fn=lambda key, hypothesis, state, action: (state, False),
            reward_fn=lambda hypothesis, state, action, after: jnp.sum(action),
            actions=actions,
            depth=2,
            leaf_fn=leaf_fn,
            num_samples=3,
        )

    check(plan, KEY)
    learn = functools.partial(planning.learned_leaf, num_features=3)
    check(learn, KEY, jnp.ones((4, 2)), jnp.ones(4))
    leaf = learn(KEY, jnp.ones((4, 2)), jnp.ones(4))
    check(leaf, None, jnp.zeros(2))
    check(plan, KEY, leaf)


def test_products_of_actions_have_all_bits():
    check(ContinuousActions(jnp.ones((1, 2, 1, 3))).wrench, jnp.ones(2))
