"""The whole way from a recording to a posterior; long, since it compiles everything."""

import jax
import numpy as np
import pytest

import boomdp_jax
from boomdp_jax.core import make_history
from boomdp_jax.interop import (
    hide,
    random_object,
    record_random_pushes,
    with_reading_noise,
)
from boomdp_jax.physics import scene_spec_from_dict

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", autouse=True)
def single_precision():
    """As users run it."""
    with jax.enable_x64(False):
        yield


@pytest.fixture(scope="module")
def recorded():
    truths, specs, histories = [], [], []
    for number, family in enumerate(("box", "table", "cart")):
        rng = np.random.default_rng([7, number])
        truth = random_object(rng, family)
        table = record_random_pushes(rng, truth, 50)
        # One reading of each instant, or two.
        noisy = with_reading_noise(rng, table, is_chained=number != 1)
        truths.append(truth)
        specs.append(hide(truth))
        histories.append(noisy.to_history())
    posteriors = boomdp_jax.infer_batch(jax.random.key(0), specs, histories)
    return truths, posteriors


def test_the_true_structure_is_the_most_probable(recorded):
    truths, posteriors = recorded
    for truth, posterior in zip(truths, posteriors, strict=True):
        first = posterior.to_json()["structure"][0]
        kinds = sorted(c["type"] for c in first["constraints"])
        assert kinds == sorted(c.kind for c in truth.constraints)
        assert first["probability"] > 0.95


def test_the_mass_is_found_within_three_per_cent(recorded):
    truths, posteriors = recorded
    for truth, posterior in zip(truths, posteriors, strict=True):
        mass = posterior.to_json()["bodies"]["object"]["mass"]
        assert mass["identified"]
        expected = truth.bodies[0].density * truth.bodies[0].area
        assert mass["q50"] == pytest.approx(expected, rel=0.03)


def test_the_pin_of_a_table_is_found_within_five_millimetres(recorded):
    truths, posteriors = recorded
    first = posteriors[1].to_json()["structure"][0]
    (pin,) = first["constraints"]
    numbers = truths[1].constraints[0].numbers
    for key in ("anchor_a", "anchor_b"):
        offset = np.subtract(pin[key]["mean"], numbers[key])
        assert np.hypot(*offset) < 5e-3


def test_chains_agree(recorded):
    for posterior in recorded[1]:
        assert posterior.diagnostics["r_hat"] < 1.05
        assert posterior.diagnostics["effective_sample_size"] > 100


def test_a_body_without_data_keeps_its_prior():
    spec = scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": 0.02,
            "bodies": [
                {
                    "name": "b",
                    "shape": {"type": "circle", "radius": 0.2},
                    "pose": [0, 0, 0],
                }
            ],
            "unknown": {"revolute": 1, "wheel": 1, "ground": 1},
        }
    )
    empty = np.zeros((0, 1, 6))
    history = make_history(empty, empty[..., :3], empty, 0.02, capacity=4)
    posterior = boomdp_jax.infer(jax.random.key(3), spec, history, num_samples=1000)
    density = np.log(np.asarray(posterior.params.density[:, 0]))
    expected = np.log(30.0) + 1.5 * np.array([-1.2816, 0.0, 1.2816])
    found = np.quantile(density, [0.1, 0.5, 0.9])
    # Four standard errors of a quantile of 4,000 draws, correlation of 4 allowed for.
    np.testing.assert_allclose(found, expected, atol=0.3)
    active = np.asarray(posterior.params.wheel.active[:, 0, 0])
    assert active.mean() == pytest.approx(0.3, abs=0.06)
    assert np.asarray(posterior.params.ground.active[:, 0, 0]).mean() == pytest.approx(
        0.5, abs=0.07
    )
    assert not posterior.to_json()["bodies"]["b"]["identified"]
