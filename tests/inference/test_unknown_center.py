"""An unknown centre of mass: found within what is stated, reported, saved."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import boomdp_jax
from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.fits.fit import FitSettings
from boomdp_jax.inference.posteriors.posterior import Posterior, load_posterior
from boomdp_jax.inference.pushes.identifiability import identifiability
from boomdp_jax.inference.under_numpyro.numpyro_model import make_model
from boomdp_jax.physics import SceneSpec, State, rollout, scene_spec_from_dict
from tests.inference.made_posteriors import table_posterior, table_spec

DT, DENSITY = 0.02, 20.0
NOISE = np.array([1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 5e-3])
BOX = {"name": "box", "shape": {"type": "box", "half_extents": [0.3, 0.2]}}
GYRATION = np.sqrt((0.3**2 + 0.2**2) / 3.0)
WEDGE = [[0.0, 0.0], [0.6, 0.0], [0.0, 0.3]]


def box_scene(unknown: dict | None = None, **body) -> SceneSpec:
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, 0.0],
            "dt": DT,
            "bodies": [{**BOX, **body}],
            "unknown": unknown or {},
        },
        source="test",
    )


def pushes(rng: np.random.Generator, center: np.ndarray, num_rows: int) -> History:
    """Noisy readings of a free box whose centre of mass is elsewhere."""
    spec = box_scene(density=DENSITY)
    params = dataclasses.replace(
        spec.params(), center_of_mass=jnp.asarray(center[None], float)
    )
    action = rng.normal(size=(num_rows, 1, 3)) * [20.0, 20.0, 2.0]
    start = State(jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    states, _ = rollout(spec.scene, params, start, jnp.asarray(action, float))
    reading = np.concatenate([np.zeros((1, 1, 6)), np.asarray(states.array)])
    reading += NOISE * rng.normal(size=reading.shape)
    return make_history(reading[:-1], action, reading[1:], DT)


@pytest.mark.slow
def test_centres_of_mass_lie_where_their_posteriors_say():
    """Errors over sds of twenty boxes; bounds of a chi-square, one in a thousand."""
    with jax.enable_x64(False):
        rng = np.random.default_rng(0)
        truth = 0.3 * GYRATION * rng.normal(size=(20, 2))
        histories = [pushes(rng, center, 30) for center in truth]
        spec = box_scene({"center_of_mass": True})
        found = boomdp_jax.infer_batch(
            jax.random.key(0), [spec] * 20, histories, num_samples=100, num_warmup=50
        )
    squares = []
    for center, posterior in zip(truth, found, strict=True):
        report = posterior.to_json()["bodies"]["box"]
        number = report["center_of_mass"]
        assert number["identified"] == [True, True]
        assert max(number["sd"]) < 2e-3
        assert report["mass"]["mean"] == pytest.approx(DENSITY * 0.24, rel=0.02)
        squares += list(((np.array(number["mean"]) - center) / number["sd"]) ** 2)
    low, high = stats.chi2(len(squares)).ppf([5e-4, 1 - 5e-4])
    assert low < np.sum(squares) < high


def test_without_data_the_prior_is_about_the_centroid():
    """Of an outline drawn from its corner, whose pose is that corner's."""
    shape = {"type": "polygon", "vertices": WEDGE}
    spec = box_scene(shape=shape, center_of_mass=None)
    empty = make_history(
        np.zeros((0, 1, 6)), np.zeros((0, 1, 3)), np.zeros((0, 1, 6)), DT, capacity=1
    )
    model = make_model(spec, empty)
    (site,) = (s for s in model.sites[0] if s.name == "box.center_of_mass")
    np.testing.assert_allclose(site.loc, [0.2, 0.1])
    # A triangle's second moments about the centroid, over its area: (b² + h²) / 18.
    np.testing.assert_allclose(site.scale, 0.3 * np.sqrt((0.6**2 + 0.3**2) / 18.0))
    coordinates = model.blocks[0].target.log_likelihood.coordinates
    z = site.to_coordinates(jnp.array([0.25, 0.02]))
    params = coordinates(jnp.concatenate([jnp.zeros(1), z]), jnp.zeros(0, bool))
    np.testing.assert_allclose(params.center_of_mass, [[0.25, 0.02]])


def test_known_centres_of_mass_leave_params_as_they_were():
    history = pushes(np.random.default_rng(0), np.zeros(2), 4)
    (block,) = make_model(box_scene(), history).blocks
    likelihood = block.target.log_likelihood
    params = likelihood.coordinates(jnp.zeros(1), jnp.zeros(0, bool))
    assert params.center_of_mass is None
    assert block.layout.numbers == ()


@pytest.mark.slow
def test_pushes_tell_mass_and_centre_and_a_body_at_rest_neither():
    rng = np.random.default_rng(1)
    history = pushes(rng, np.array([0.05, -0.03]), 30)
    quick = FitSettings(num_draws=16, num_starts=2, num_iterations=6)
    spec = box_scene({"center_of_mass": True})
    (found,) = identifiability(jax.random.key(0), spec, history, settings=quick)
    assert found.names == (
        "box.density",
        "box.center_of_mass[0]",
        "box.center_of_mass[1]",
    )
    assert np.all(found.contraction > 0.99)
    still = eqx.tree_at(lambda h: h.action, history, jnp.zeros_like(history.action))
    resting = eqx.tree_at(
        lambda h: (h.state, h.next_state),
        still,
        (
            jnp.asarray(NOISE * rng.normal(size=history.state.shape)),
            jnp.asarray(NOISE * rng.normal(size=history.state.shape)),
        ),
    )
    (unseen,) = identifiability(jax.random.key(0), spec, resting, settings=quick)
    assert set(unseen.insensitive) == set(found.names)


def center_posterior() -> Posterior:
    """A table whose centre of mass is known to a millimetre or two."""
    spec = table_spec(center_of_mass=None)
    known = table_posterior(40, spec)
    rng = np.random.default_rng(4)
    draws = np.array([0.05, -0.02]) + [0.001, 0.002] * rng.normal(size=(40, 1, 2))
    prior = 0.06 * rng.normal(size=(500, 1, 2))
    return eqx.tree_at(
        lambda p: (p.params.center_of_mass, p.prior_params.center_of_mass),
        known,
        (jnp.asarray(draws), jnp.asarray(prior)),
        is_leaf=lambda leaf: leaf is None,
    )


def test_reports_say_where_the_centre_of_mass_is():
    posterior = center_posterior()
    number = posterior.to_json()["bodies"]["table"]["center_of_mass"]
    draws = np.asarray(posterior.params.center_of_mass)[:, 0]
    np.testing.assert_allclose(number["mean"], draws.mean(axis=0))
    assert number["identified"] == [True, True]
    (line,) = (x for x in posterior.summary().splitlines() if "centre of mass" in x)
    printed = float(line.partition("centre of mass")[2].split()[0])
    assert printed == pytest.approx(draws[:, 0].mean(), abs=1e-4)
    converted = posterior.to_arviz()["posterior"]["center_of_mass"]
    assert converted.dims == ("chain", "draw", "body", "axis")
    np.testing.assert_array_equal(converted.values.reshape(-1, 2), draws)


def test_a_saved_centre_of_mass_comes_back_to_the_bit(tmp_path):
    posterior = center_posterior()
    posterior.save(tmp_path / "post.npz")
    loaded = load_posterior(tmp_path / "post.npz")
    np.testing.assert_array_equal(
        loaded.params.center_of_mass, posterior.params.center_of_mass
    )
    assert loaded.to_json() == posterior.to_json()
    with np.load(tmp_path / "post.npz") as file:
        arrays = dict(file)
    del arrays["prior_params.center_of_mass"]
    with open(tmp_path / "half.npz", "wb") as file:
        np.savez(file, **arrays)
    message = "prior_params.center_of_mass: the array is missing"
    with pytest.raises(ValueError, match=message):
        load_posterior(tmp_path / "half.npz")


@pytest.mark.slow
def test_a_predicted_transition_turns_about_the_centre_of_mass():
    """A push at the middle makes a box turn by the arm over the inertia."""
    posterior = center_posterior()
    quiet = eqx.tree_at(
        lambda p: (
            p.noise_scale,
            p.params.revolute.active,
            p.params.wheel.active,
            p.params.center_of_mass,
        ),
        posterior,
        (
            jnp.zeros_like(posterior.noise_scale),
            jnp.zeros((40, 1), bool),
            jnp.zeros((40, 1, 1), bool),
            jnp.broadcast_to(jnp.array([0.05, -0.02]), (40, 1, 2)),
        ),
    )
    mass = np.asarray(quiet.params.density)[:, 0] * 0.24
    inertia = mass * (0.3**2 + 0.2**2) / 3.0
    state = State(jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    after = quiet.transition(jax.random.key(0), state, jnp.array([[0.0, 3.0, 0.0]]))
    spins = -0.05 * 3.0 / inertia * 0.02
    spin = float(after.twist[0, 2])
    assert spins.min() * 1.0001 < spin < spins.max() * 0.9999
