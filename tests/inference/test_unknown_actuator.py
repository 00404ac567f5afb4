"""Gain, bias and delay of what was commanded: found, reported, saved, confounded."""

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
from boomdp_jax.inference.kinds.infer_kinds import infer_kinds
from boomdp_jax.inference.online.belief import OnlineBelief
from boomdp_jax.inference.posteriors.posterior import load_posterior
from boomdp_jax.inference.pushes.identifiability import identifiability
from boomdp_jax.inference.under_numpyro.numpyro_model import make_model
from boomdp_jax.physics import (
    Actuator,
    SceneSpec,
    State,
    delayed_wrenches,
    rollout,
    scene_spec_from_dict,
)
from tests.inference.made_posteriors import table_posterior

DT, DENSITY = 0.02, 20.0
NOISE = np.array([1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 5e-3])
ALL = {"actuator": ["gain", "bias", "delay"]}


def box_scene(unknown: dict | None = None, **fields) -> SceneSpec:
    body = {"name": "box", "shape": {"type": "box", "half_extents": [0.3, 0.2]}}
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, 0.0],
            "dt": DT,
            "bodies": [body | {"density": DENSITY}],
            "unknown": unknown or {},
            **fields,
        },
        source="test",
    )


def pushes(rng, num_rows: int, *, noise=NOISE, **actuator) -> History:
    """Noisy readings of a box, its commands switched at the time and not at a row."""
    spec, fine = box_scene(), 50
    delay = actuator.pop("delay", 0.0)
    numbers = {key: jnp.asarray([value], float) for key, value in actuator.items()}
    params = dataclasses.replace(spec.params(), actuator=Actuator(**numbers))
    action = rng.normal(size=(num_rows, 1, 3)) * [20.0, 20.0, 2.0]
    times = (np.arange(num_rows * fine) + 0.5) * DT / fine - delay
    source = np.floor(times / DT).astype(int)
    held = np.where((source >= 0)[:, None, None], action[np.maximum(source, 0)], 0.0)
    start = State(jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    states, _ = rollout(
        spec.scene, params, start, jnp.asarray(held, float), dt=DT / fine
    )
    reading = np.asarray(states.array)[fine - 1 :: fine]
    reading = np.concatenate([np.zeros((1, 1, 6)), reading])
    reading = reading + noise * rng.normal(size=reading.shape)
    return make_history(reading[:-1], action, reading[1:], DT)


@pytest.mark.slow
def test_gains_biases_and_delays_lie_where_their_posteriors_say():
    """Errors over sds of twenty boxes; bounds of a chi-square, one in a thousand."""
    with jax.enable_x64(False):
        rng = np.random.default_rng(0)
        truths = [
            {
                "gain": np.exp(0.3 * rng.normal()),
                "bias": rng.normal(size=3) * [3.0, 3.0, 0.5],
                "delay": rng.uniform(0.0, 0.06),
            }
            for _ in range(20)
        ]
        histories = [pushes(rng, 40, **dict(truth)) for truth in truths]
        found = boomdp_jax.infer_batch(
            jax.random.key(0),
            [box_scene(ALL)] * 20,
            histories,
            num_samples=100,
            num_warmup=50,
        )
    squares = []
    for truth, posterior in zip(truths, found, strict=True):
        report = posterior.to_json()["bodies"]["box"]
        for name, value in truth.items():
            number = report[f"actuator.{name}"]
            assert np.all(number["identified"])
            error = (np.array(number["mean"]) - value) / number["sd"]
            squares += list(np.ravel(error**2))
    low, high = stats.chi2(len(squares)).ppf([5e-4, 1 - 5e-4])
    assert low < np.sum(squares) < high


@pytest.mark.slow
def test_a_gain_and_a_mass_are_told_apart_by_nothing_but_the_mass():
    """Their product with opposite powers is seen, the other direction is not."""
    body = {"name": "box", "shape": {"type": "box", "half_extents": [0.3, 0.2]}}
    spec = box_scene(
        {"actuator": ["gain"]}, bodies=[body], prior={"density": {"spread": 0.3}}
    )
    history = pushes(np.random.default_rng(1), 30, gain=0.8)
    quick = FitSettings(num_draws=16, num_starts=2, num_iterations=6)
    (found,) = identifiability(jax.random.key(0), spec, history, settings=quick)
    assert found.names == ("box.density", "box.actuator.gain")
    (unseen,) = found.unseen
    # Both have the same spread, so that they rise together.
    assert unseen["box.density"] == pytest.approx(unseen["box.actuator.gain"], abs=0.02)
    np.testing.assert_allclose(found.contraction, 0.5, atol=0.02)
    (known,) = identifiability(
        jax.random.key(0), box_scene({"actuator": ["gain"]}), history, settings=quick
    )
    assert known.contraction[known.names.index("box.actuator.gain")] > 0.99


@pytest.mark.slow
def test_sites_of_a_model_are_the_physical_numbers():
    spec = box_scene(ALL)
    model = make_model(spec, pushes(np.random.default_rng(2), 6))
    sites = {site.name: site for site in model.sites[0]}
    names = [f"box.actuator.{name}" for name in ALL["actuator"]]
    assert set(sites) == set(names)
    coordinates = model.blocks[0].target.log_likelihood.coordinates
    values = {
        "box.actuator.gain": jnp.asarray(0.8),
        "box.actuator.bias": jnp.array([1.0, -2.0, 0.3]),
        "box.actuator.delay": jnp.asarray(0.03),
    }
    z = jnp.zeros(model.blocks[0].layout.dim)
    for name, value in values.items():
        place = jnp.asarray(sites[name].coordinates)
        z = z.at[place].set(sites[name].to_coordinates(value))
        np.testing.assert_allclose(sites[name].from_coordinates(z), value)
    actuator = coordinates(z, jnp.zeros(0, bool)).actuator
    np.testing.assert_allclose(actuator.gain, [0.8])
    np.testing.assert_allclose(actuator.bias, [[1.0, -2.0, 0.3]])
    np.testing.assert_allclose(actuator.delay, [0.03])


def actuator_posterior(**numbers):
    """A table posterior in which every draw has these numbers, about."""
    rng = np.random.default_rng(3)
    given = {"gain": (0.8, (1,)), "bias": (1.0, (1, 3)), "delay": (0.03, (1,))}

    def actuator(num, spread):
        return Actuator(
            **{
                key: jnp.asarray(
                    numbers.get(key, value) + spread * rng.normal(size=(num, *shape))
                )
                for key, (value, shape) in given.items()
            }
        )

    return eqx.tree_at(
        lambda p: (p.params.actuator, p.prior_params.actuator),
        table_posterior(40),
        (actuator(40, 1e-3), actuator(500, 0.3)),
        is_leaf=lambda leaf: leaf is None,
    )


def test_reports_and_files_tell_of_the_actuator(tmp_path):
    posterior = actuator_posterior()
    report = posterior.to_json()["bodies"]["table"]
    gain = np.asarray(posterior.params.actuator.gain)[:, 0]
    assert report["actuator.gain"]["mean"] == pytest.approx(gain.mean())
    assert report["actuator.bias"]["identified"] == [True] * 3
    for title in ("actuator gain", "actuator bias", "actuator delay"):
        assert title in posterior.summary()
    found = posterior.to_arviz()["posterior"]
    assert found["actuator_bias"].dims == ("chain", "draw", "body", "wrench")
    np.testing.assert_array_equal(found["actuator_gain"].values.reshape(-1), gain)
    posterior.save(tmp_path / "post.npz")
    loaded = load_posterior(tmp_path / "post.npz")
    for mine, its in zip(
        jax.tree.leaves(posterior), jax.tree.leaves(loaded), strict=True
    ):
        np.testing.assert_array_equal(mine, its)
    assert loaded.to_json() == posterior.to_json()


@pytest.mark.slow
def test_predictions_know_the_commands_from_before_their_start():
    """From the middle of a run, what was commanded earlier has yet to take effect."""
    quiet = 1e-6 * np.ones(6)
    truth = {"gain": 0.8, "bias": [1.0, -0.5, 0.1], "delay": 0.04}
    history = pushes(np.random.default_rng(4), 20, noise=quiet, **dict(truth))
    numbers = {k: jnp.asarray([v], float) for k, v in truth.items()}

    def score(**numbers):
        one = dataclasses.replace(box_scene().params(), actuator=Actuator(**numbers))
        known = table_posterior(40)
        posterior = boomdp_jax.Posterior(
            params=jax.tree.map(lambda x: jnp.broadcast_to(x, (40, *x.shape)), one),
            prior_params=one,
            spec=box_scene(),
            inferred={
                "revolute": np.zeros(0, bool),
                "distance": np.zeros(0, bool),
                "wheel": np.zeros((1, 0), bool),
                "ground": np.zeros((1, 0), bool),
            },
            noise_scale=1e-6 * jnp.ones((40, 1, 4)),
            prior_noise_scale=known.prior_noise_scale,
            log_weight=known.log_weight,
            log_density=known.log_density,
            chain=known.chain,
        )
        return posterior.predict(history, (3,))["horizons"]["3"]["velocity"]["rmse"]

    assert score(**numbers) < 1e-5
    del numbers["delay"]
    assert score(**numbers) > 1e-2


def test_what_cannot_keep_commands_refuses_a_delay():
    with pytest.raises(ValueError, match=r"test: unknown\.actuator: expected no delay"):
        OnlineBelief(box_scene(ALL))
    history = pushes(np.random.default_rng(5), 3)
    with pytest.raises(ValueError, match=r"test: unknown: actuator\..*not supported"):
        infer_kinds(jax.random.key(0), [box_scene(ALL)], [history])


@pytest.mark.slow
def test_delayed_rows_are_those_that_the_filter_steps_through():
    """A likelihood with a delay is that of a history whose actions were delayed."""
    spec = box_scene({"actuator": ["delay"]})
    history = pushes(np.random.default_rng(6), 12, delay=0.03)
    model = make_model(spec, history)
    likelihood = model.blocks[0].target.log_likelihood
    (site,) = model.sites[0]
    z = jnp.concatenate([jnp.zeros(1), site.to_coordinates(jnp.asarray(0.03))])
    params = likelihood.coordinates(z, jnp.zeros(0, bool))
    moved = delayed_wrenches(params, np.asarray(history.action), DT)
    plain = make_model(
        box_scene(), eqx.tree_at(lambda h: h.action, history, jnp.asarray(moved))
    )
    other = plain.blocks[0].target.log_likelihood
    off = jnp.zeros(0, bool)
    np.testing.assert_allclose(
        float(likelihood(z, off)), float(other(jnp.zeros(1), off)), rtol=1e-12
    )
    assert (
        abs(
            float(likelihood(jnp.zeros(2).at[1].set(1.0), off))
            - float(likelihood(z, off))
        )
        > 1.0
    )
