"""NUTS on whole scenes: long, since each layout compiles a gradient."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from boomdp_jax.core import make_history
from boomdp_jax.inference.blocks.fixed_structure import structure_blocks
from boomdp_jax.inference.likelihoods.one_step import OneStepLikelihood
from boomdp_jax.inference.under_numpyro.numpyro_model import make_model, model_of_blocks
from boomdp_jax.inference.under_numpyro.nuts import run_nuts
from boomdp_jax.inference.under_numpyro.nuts_chains import sample_model
from tests.inference.under_numpyro.test_numpyro_model import make_spec, pushed


@pytest.mark.slow
def test_mass_of_a_free_box_agrees_with_quadrature():
    """One coordinate once the noise is integrated out: a grid does it."""
    spec = make_spec(unknown={})
    history = pushed(spec, num_rows=15)
    posterior = run_nuts(
        jax.random.key(0), spec, history, num_warmup=300, num_samples=1000
    )
    assert posterior.diagnostics["ok"], posterior.diagnostics["reasons"]
    assert posterior.diagnostics["method"] == "nuts"
    assert np.isnan(posterior.log_evidence)
    (block,) = structure_blocks(spec, history)
    z = jnp.linspace(-1.5, 1.5, 20001)[:, None]
    value = jax.vmap(lambda z: block.target.log_density(jnp.asarray(0), z))(z)
    weight = np.exp(np.asarray(value) - np.max(value))
    level = np.cumsum(weight) / weight.sum()
    drawn = (np.log(np.asarray(posterior.params.density[:, 0])) - np.log(30.0)) / 1.5
    size = posterior.diagnostics["effective_sample_size"]
    assert size > 400
    for p in (0.05, 0.25, 0.5, 0.75, 0.95):
        truth = np.interp(p, level, np.asarray(z[:, 0]))
        # A share of draws below a known quantile; a false alarm once in a thousand.
        slack = scipy.stats.norm.isf(1e-4) * np.sqrt(p * (1 - p) / 400)
        assert np.mean(drawn < truth) == pytest.approx(p, abs=slack)
    # Given coordinates and noise prior, the noise has a closed form: check its mean.
    mode = float(z[np.argmax(weight), 0])
    tracked = block.target.log_likelihood
    plain = OneStepLikelihood(tracked.coordinates, tracked.data.steps)
    statistics = plain.statistics(jnp.asarray([mode]), jnp.zeros(0, bool))
    shape = 1.0 + 0.5 * np.asarray(statistics.num[0])
    rate = np.array([1e-3, 1e-3, 4e-3, 4e-3]) ** 2 + 0.5 * np.asarray(
        statistics.square[0]
    )
    expected = scipy.stats.gamma(shape, scale=1 / rate)
    precision = np.asarray(posterior.noise_scale[:, 0]) ** -2.0
    # The mass moves the sums of squares by about one part in the number of readings.
    np.testing.assert_allclose(precision.mean(0), expected.mean(), rtol=0.15)


@pytest.mark.slow
def test_without_data_nuts_returns_the_prior():
    spec = make_spec()
    empty = np.zeros((0, 1, 6))
    history = make_history(empty, empty[..., :3], empty, 0.02, capacity=4)
    posterior = run_nuts(
        jax.random.key(1),
        spec,
        history,
        structure={"table": ["wheel"]},
        num_samples=1000,
    )
    size = posterior.diagnostics["effective_sample_size"]
    assert size > 300
    slack = scipy.stats.norm.isf(1e-4) * np.sqrt(0.25 / 300)
    density = np.asarray(posterior.params.density[:, 0])
    half_track = np.asarray(posterior.params.wheel.half_track[:, 0, 0])
    heading = np.asarray(posterior.params.wheel.heading[:, 0, 0])
    for draws, distribution in (
        (density, scipy.stats.lognorm(1.5, scale=30.0)),
        (half_track, scipy.stats.lognorm(0.7, scale=0.2 * np.hypot(0.2, 0.1))),
        (heading, scipy.stats.uniform(-np.pi / 2, np.pi)),
    ):
        for p in (0.1, 0.5, 0.9):
            share = np.mean(draws < distribution.ppf(p))
            assert share == pytest.approx(p, abs=slack)
    assert not posterior.to_json()["bodies"]["table"]["identified"]


@pytest.fixture(scope="module")
def free_boxes():
    """Two equal boxes that are pushed apart, and their posterior."""
    spec = make_spec(names=("left", "right"), unknown={"wheel": 1})
    history = pushed(spec, num_rows=40)
    posterior = run_nuts(
        jax.random.key(2), spec, history, structure={}, num_warmup=100, num_samples=100
    )
    return spec, history, posterior


@pytest.mark.slow
def test_a_posterior_by_nuts_is_like_any_other(free_boxes, tmp_path):
    _, _, posterior = free_boxes
    assert posterior.num_draws == 400
    np.testing.assert_array_equal(np.unique(posterior.chain), np.arange(4))
    assert posterior.structure_probabilities() == {"free": pytest.approx(1.0)}
    report = posterior.to_json()
    assert report["log_evidence"] is None
    for name in ("left", "right"):
        # The truth is 2.4 kg; five posterior standard deviations.
        mass = report["bodies"][name]["mass"]
        assert abs(mass["mean"] - 2.4) < 5 * mass["sd"]
    assert posterior.diagnostics["divergences"] >= 0
    posterior.save(tmp_path / "post.npz")
    assert "log-evidence  not computed" in posterior.summary()


@pytest.mark.slow
def test_bodies_of_equal_layout_share_one_program(free_boxes):
    """Whatever they are called and wherever they are listed."""
    spec, history, _ = free_boxes
    shapes, static = zip(
        *(
            eqx.partition(
                model_of_blocks([block._replace(bodies=(0,))], ("body_0",)),
                eqx.is_array,
            )
            for block in structure_blocks(spec, history, {})
        ),
        strict=True,
    )
    assert eqx.tree_equal(*static)
    first, second = (jax.tree.map(jnp.shape, each) for each in shapes)
    assert first == second


@pytest.mark.slow
def test_the_most_probable_structure_is_chosen_and_named():
    spec = make_spec(unknown={"revolute": 1})
    history = pushed(spec, num_rows=40)
    posterior = run_nuts(
        jax.random.key(3), spec, history, num_warmup=100, num_samples=100
    )
    assert posterior.structure_probabilities() == {"free": pytest.approx(1.0)}
    (note,) = [n for n in posterior.diagnostics["notes"] if "NUTS" in n]
    assert note.startswith("table: structure {}, of probability 1.00")


@pytest.mark.slow
def test_few_draws_are_not_ok_and_the_reasons_name_the_number():
    spec = make_spec(unknown={})
    model = make_model(spec, pushed(spec))
    draws = sample_model(jax.random.key(0), model, num_warmup=20, num_samples=10)
    assert not draws.diagnostics.ok
    assert any("table.density: effective" in r for r in draws.diagnostics.reasons)
    assert draws.z.shape == (4, 10, 1)


def test_bad_input_is_refused():
    spec = make_spec()
    history = pushed(spec)
    with pytest.raises(ValueError, match="num_samples: expected at least 1, got 0"):
        run_nuts(jax.random.key(0), spec, history, num_samples=0)
    with pytest.raises(ValueError, match="expected 2 bodies, got 1"):
        run_nuts(jax.random.key(0), make_spec(names=("a", "b")), history)
    with pytest.raises(ValueError, match="got 'lamp'"):
        run_nuts(jax.random.key(0), spec, history, structure={"lamp": []})
