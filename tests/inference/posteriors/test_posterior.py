"""The posterior container: reports, thinning, sampling, the generative transition."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.inference.posteriors.random_motion import add_reading_noise
from boomdp_jax.physics import State, empty_params
from boomdp_jax.physics.scene_spec import scene_spec_from_dict
from tests.inference.made_posteriors import (
    draws_like,
    make_posterior,
    room_spec,
    table_posterior,
    table_prior,
    table_spec,
)

SUMMARY = {"mean", "sd", "q05", "q50", "q95", "identified"}


def free_posterior(density, **fields) -> Posterior:
    """A box without any constraint slot."""
    density = np.asarray(density, float)[:, None]
    params = draws_like(empty_params(1), len(density), density=jnp.asarray(density))
    return make_posterior(table_spec(), params, params, **fields)


def test_the_report_has_every_field_of_its_schema():
    report = table_posterior(80).to_json()
    assert report["schema"] == "boomdp-infer-1"
    assert set(report) >= {
        "bodies",
        "structure",
        "noise",
        "log_evidence",
        "diagnostics",
        "seconds",
    }
    assert report["log_evidence"] == 12.5
    assert report["seconds"] == {"compile": 1.0, "run": 0.5}
    assert report["diagnostics"]["ok"] is True
    assert set(report["bodies"]["table"]["mass"]) == SUMMARY
    assert set(report["noise"]["table"]) == {"position", "angle", "velocity", "spin"}
    for constraint in report["structure"][1]["constraints"]:
        for value in constraint.values():
            assert isinstance(value, str) or set(value) == SUMMARY


def test_the_report_is_json_without_nan(precision):
    posterior = table_posterior(80, log_evidence=float("nan"))
    text = json.dumps(posterior.to_json(), allow_nan=False)
    assert json.loads(text)["log_evidence"] is None
    assert posterior.params.density.dtype == jnp.dtype(f"float{precision.bits}")


def test_the_summary_says_what_the_numbers_of_the_noise_are():
    """A Student-t of 4 degrees of freedom has the square root of two scales as sd."""
    assert "noise of one reading (sd)" in table_posterior(80).summary()
    robust = {"ok": True, "reasons": [], "degrees_of_freedom": 4.0}
    lines = table_posterior(80, diagnostics=robust).summary().splitlines()
    (line,) = [line for line in lines if line.startswith("noise of one reading")]
    assert "scale of Student-t noise of 4 degrees of freedom" in line
    assert "sd is 1.41 times that" in line


def test_mass_is_density_times_area():
    posterior = table_posterior(400)
    body = posterior.to_json()["bodies"]["table"]
    mass = np.asarray(posterior.params.density)[:, 0] * 0.6 * 0.4
    assert body["identified"] is True
    assert body["mass"]["mean"] == pytest.approx(mass.mean())
    assert body["mass"]["sd"] == pytest.approx(mass.std())
    assert body["mass"]["q05"] == pytest.approx(np.quantile(mass, 0.05, method="hazen"))


def test_a_mass_that_was_not_learnt_is_the_priors():
    prior = table_prior()
    posterior = make_posterior(table_spec(), prior, prior)
    body = posterior.to_json()["bodies"]["table"]
    assert body["identified"] is False
    mass = np.asarray(prior.density)[:, 0] * 0.6 * 0.4
    assert body["mass"]["q95"] == pytest.approx(np.quantile(mass, 0.95, method="hazen"))


def test_a_density_in_the_scene_file_is_known():
    params = draws_like(empty_params(1, density=20.0), 50)
    posterior = make_posterior(table_spec(density=20.0), params, params)
    body = posterior.to_json()["bodies"]["table"]
    assert body["identified"] is True
    assert body["density"]["mean"] == pytest.approx(20.0)


def test_static_bodies_are_left_out():
    params = draws_like(empty_params(3, num_revolute=2, num_wheel=2), 20)
    report = make_posterior(room_spec(), params, params).to_json()
    assert list(report["bodies"]) == ["table", "chair"]
    assert list(report["noise"]) == ["table", "chair"]


def test_the_table_names_structures_and_failures():
    posterior = table_posterior(
        80, diagnostics={"ok": False, "reasons": ["R-hat 1.3", "one chain is stuck"]}
    )
    text = posterior.summary()
    assert "pin + wheel" in text
    assert "0.750" in text
    assert "N m s/rad" in text
    assert "NOT OK: R-hat 1.3; one chain is stuck" in text
    assert "12.50" in text


def test_thinning_keeps_shares_by_weight():
    # Every fourth draw has the wheel: a rule with a period would keep all or none.
    weights = np.where(np.arange(4000) % 4 == 0, 9.0, 1.0)
    thin = table_posterior(4000, weights=weights).thin(1000)
    assert thin.num_draws == 1000
    np.testing.assert_allclose(thin.weights, 0.001)
    share = thin.structure_probabilities()["pin + wheel"]
    # Five standard errors of independent draws; strata only lower it.
    assert share == pytest.approx(0.75, abs=5 * (0.75 * 0.25 / 1000) ** 0.5)


def test_thinning_to_more_draws_changes_nothing():
    posterior = table_posterior(40)
    assert posterior.thin(1000) is posterior
    with pytest.raises(ValueError, match="num_draws: expected at least 1, got 0"):
        posterior.thin(0)
    with pytest.raises(ValueError, match=r"num_draws: expected a whole .*, got True"):
        posterior.thin(True)


def test_a_bad_number_of_samples_is_refused():
    posterior, key = table_posterior(4), jax.random.key(0)
    with pytest.raises(ValueError, match="num_samples: expected at least 0, got -1"):
        posterior.sample_params(key, -1)
    with pytest.raises(ValueError, match=r"num_samples: expected a whole .*, got True"):
        posterior.sample_params(key, True)
    assert posterior.sample_params(key, 0).density.shape[0] == 0


def test_sampled_params_follow_the_weights():
    weights = np.where(np.arange(400) % 4 == 0, 9.0, 1.0)
    posterior = table_posterior(400, weights=weights)
    params = posterior.sample_params(jax.random.key(0), 4000)
    share = float(params.wheel.active.mean())
    # Five standard errors of a share of 3/4.
    assert share == pytest.approx(0.75, abs=5 * (0.75 * 0.25 / 4000) ** 0.5)


@pytest.mark.slow
def test_a_transition_is_a_step_of_a_draw_plus_noise():
    noise = np.array([0.001, 0.002, 0.005, 0.01])
    mass = np.array([10.0, 20.0, 40.0]) * 0.24
    posterior = free_posterior([10.0, 20.0, 40.0], noise_scale=tuple(noise))
    state = State(
        pose=jnp.array([[0.5, -0.2, 1.0]]), twist=jnp.array([[0.3, 0.0, 2.0]])
    )
    force = 12.0
    wrench = jnp.array([[0.0, force, 0.0]])
    keys = jax.random.split(jax.random.key(1), 3000)
    draw = jax.jit(jax.vmap(lambda key: posterior.transition(key, state, wrench)))
    readings = np.asarray(draw(keys).array)[:, 0]
    dt = 0.02
    gain = force / mass * dt
    # Mean and variance over the three masses and the noise, in closed form.
    mean = [
        0.5 + 0.3 * dt,
        -0.2 + 0.5 * dt * gain.mean(),
        1 + 2 * dt,
        0.3,
        gain.mean(),
        2,
    ]
    variance = np.array([0, (0.5 * dt) ** 2 * gain.var(), 0, 0, gain.var(), 0])
    variance = variance + noise[[0, 0, 1, 2, 2, 3]] ** 2
    error = np.abs(readings.mean(axis=0) - mean) / np.sqrt(variance / len(keys))
    assert error.max() < 5.0
    np.testing.assert_allclose(readings.var(axis=0), variance, rtol=0.15)


def test_readings_of_static_bodies_have_no_noise():
    spec = room_spec()
    state = spec.initial_state()
    after = add_reading_noise(
        jax.random.key(0), state, jnp.full((3, 4), 0.01), spec.scene.is_static
    )
    np.testing.assert_array_equal(after.array[0], state.array[0])
    assert np.all(np.asarray(after.array[1:]) != np.asarray(state.array[1:]))


def test_a_posterior_passes_through_jit():
    posterior = table_posterior(40)
    total = jax.jit(lambda given: given.params.density.sum() + given.log_evidence)
    expected = float(np.asarray(posterior.params.density).sum()) + 12.5
    assert float(total(posterior)) == pytest.approx(expected)
    assert float(total(posterior)) == pytest.approx(expected)
    assert total._cache_size() == 1


def test_methods_of_a_posterior_can_be_given_to_jit_and_vmap():
    posterior, key = free_posterior([10.0, 20.0]), jax.random.key(0)
    state, wrench = posterior.spec.initial_state(), jnp.ones((1, 3))
    once = posterior.transition(key, state, wrench)
    draw = jax.jit(posterior.transition)
    for _ in range(2):
        # As it stands, and while something around it is traced.
        again = jax.jit(lambda: jax.jit(posterior.transition)(key, state, wrench))()
        for found in (draw(key, state, wrench), again):
            np.testing.assert_allclose(found.array, once.array, rtol=1e-6)
    keys = jax.random.split(key, 3)
    many = jax.jit(jax.vmap(posterior.transition, (0, None, None)))
    assert many(keys, state, wrench).array.shape == (3, 1, 6)
    sample = jax.jit(posterior.sample_params, static_argnums=1)
    np.testing.assert_array_equal(
        sample(key, 5).density, posterior.sample_params(key, 5).density
    )


def test_posteriors_compare_by_identity():
    posterior, other = free_posterior([10.0]), free_posterior([10.0])
    assert posterior != other
    assert {posterior: 1}[posterior] == 1
    key, state = jax.random.key(0), posterior.spec.initial_state()
    heavy = free_posterior([1e6])
    push = jnp.full((1, 3), 100.0)
    found = [jax.jit(p.transition)(key, state, push).twist for p in (posterior, heavy)]
    assert np.all(np.abs(found[0]) > 10 * np.abs(found[1]))


ZEROS = np.zeros((1, 3))


@pytest.mark.parametrize(
    ("state", "wrench", "message"),
    [
        (np.zeros((1, 6)), ZEROS, "state: expected a State, got ndarray"),
        ((ZEROS[0], ZEROS[0]), ZEROS, r"state.pose: expected shape \(1, 3\), one"),
        ((ZEROS, np.zeros((2, 3))), ZEROS, r"state.twist: .* got \(2, 3\)"),
        ((ZEROS, 1j * ZEROS), ZEROS, "state.twist: expected real .* complex128"),
        ((ZEROS, ZEROS), ZEROS[0], r"wrench: expected shape .* got \(3,\)"),
    ],
)
@pytest.mark.usefixtures("no_type_checks")
def test_a_transition_of_something_else_is_refused(state, wrench, message):
    state = State(*state) if isinstance(state, tuple) else state
    with pytest.raises((TypeError, ValueError), match=message):
        free_posterior([10.0]).transition(jax.random.key(0), state, wrench)


@pytest.mark.filterwarnings("error")
@pytest.mark.usefixtures("no_type_checks")
@pytest.mark.parametrize("dtype", [int, np.float64])
def test_a_transition_takes_integers_and_numpy_without_a_warning(dtype):
    with jax.enable_x64(False):
        posterior, key = free_posterior([10.0]), jax.random.key(0)
        state = State(np.zeros((1, 3), dtype), np.ones((1, 3), dtype))
        found = posterior.transition(key, state, np.ones((1, 3), dtype))
        assert found.pose.dtype == jnp.float32
        # A fiftieth of a second at one metre a second.
        np.testing.assert_allclose(found.pose, 0.02, atol=0.05)


@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit])
def test_the_draw_to_take_is_the_densest_of_the_likeliest_structure(wrap):
    """A quarter has a wheel, which draw 0 does, and so has the densest one of all."""
    density = jnp.linspace(-1.0, 1.0, 80).at[4].set(7.0).at[6].set(5.0)
    posterior = table_posterior(80, log_density=density)
    ranking = np.asarray(wrap(lambda p: p.ranking())(posterior))
    has_wheel = np.arange(80) % 4 == 0
    assert np.argmax(ranking) == 6
    np.testing.assert_array_equal(ranking > -np.inf, ~has_wheel)
    np.testing.assert_allclose(ranking[~has_wheel], density[~has_wheel])


def test_one_structure_may_be_in_several_slots():
    spec = scene_spec_from_dict(table_spec().to_dict() | {"unknown": {"revolute": 2}})
    active = np.arange(10)[:, None] % 2 == np.array([0, 1])
    active[:4] = False
    params = draws_like(empty_params(1, num_revolute=2), 10, revolute_active=active)
    posterior = make_posterior(spec, params, params)
    np.testing.assert_array_equal(posterior.ranking() > -np.inf, np.arange(10) >= 4)
