"""One recording by every method; long, since each compiles programs of its own."""

import jax
import numpy as np
import pytest

import boomdp_jax
from boomdp_jax.interop import (
    hide,
    random_object,
    record_random_pushes,
    with_reading_noise,
)

pytestmark = pytest.mark.slow

OVER_STRUCTURES = ("rj", "enumerate", "smc", "laplace")


@pytest.fixture(scope="module", autouse=True)
def single_precision():
    """As users run it."""
    with jax.enable_x64(False):
        yield


@pytest.fixture(scope="module")
def recorded():
    """A box, and what is true of it."""
    rng = np.random.default_rng([11, 0])
    truth = random_object(rng, "box")
    table = record_random_pushes(rng, truth, 30)
    return truth, hide(truth), with_reading_noise(rng, table).to_history()


@pytest.fixture(scope="module")
def posteriors(recorded):
    _, spec, history = recorded
    return {
        method: boomdp_jax.infer(jax.random.key(5), spec, history, method=method)
        for method in (*OVER_STRUCTURES, "map", "svi")
    }


def log_density_of(posterior):
    return np.log(np.asarray(posterior.params.density, float)[:, 0])


@pytest.mark.parametrize("method", OVER_STRUCTURES[1:])
def test_odds_agree_with_those_of_jumps(posteriors, method):
    first = posteriors["rj"].structure_probabilities()
    second = posteriors[method].structure_probabilities()
    names = first.keys() | second.keys()
    gap = sum(abs(first.get(n, 0.0) - second.get(n, 0.0)) for n in names)
    assert 0.5 * gap < 0.02


@pytest.mark.parametrize("method", ["enumerate", "smc"])
def test_evidence_agrees_within_its_stated_error(posteriors, method):
    pair = [posteriors[name] for name in ("rj", method)]
    errors = [p.diagnostics["log_evidence_error"] for p in pair]
    gap = float(pair[0].log_evidence - pair[1].log_evidence)
    # Single precision adds some hundredths of a nat.
    assert abs(gap) < 4.5 * np.hypot(*errors) + 0.05
    assert max(errors) < 0.2


@pytest.mark.parametrize("method", OVER_STRUCTURES[1:])
def test_the_density_agrees_with_that_of_jumps(posteriors, method):
    first = log_density_of(posteriors["rj"])
    second = log_density_of(posteriors[method])
    sd = first.std()
    assert abs(first.mean() - second.mean()) < 0.25 * sd
    assert second.std() == pytest.approx(sd, rel=0.2)


@pytest.mark.parametrize("method", ["rj", "enumerate", "smc"])
def test_diagnostics_are_ok_and_tell_of_every_structure(posteriors, method):
    posterior = posteriors[method]
    assert posterior.diagnostics["ok"], posterior.diagnostics["reasons"]
    (table,) = posterior.diagnostics["evidence"]
    assert table["bodies"] == ["object"]
    rows = table["structures"]
    assert len(rows) == 8
    assert sum(row["probability"] for row in rows) == pytest.approx(1.0, abs=1e-4)
    first = rows[0]["constraints"]
    assert first == {}
    # The report goes into files and onto the command line.
    assert posterior.to_json()["diagnostics"]["evidence"][0]["bodies"] == ["object"]


def test_the_best_hypothesis_is_one_draw_near_the_mean(posteriors):
    best = posteriors["map"]
    assert best.num_draws == 1
    draws = log_density_of(posteriors["rj"])
    assert abs(log_density_of(best)[0] - draws.mean()) < 1.5 * draws.std()


def test_a_normal_fit_agrees_with_nuts(recorded, posteriors):
    _, spec, history = recorded
    nuts = boomdp_jax.infer(
        jax.random.key(6), spec, history, method="nuts", structure={}
    )
    fitted = posteriors["svi"]
    assert fitted.diagnostics["ok"], fitted.diagnostics["reasons"]
    first, second = log_density_of(nuts), log_density_of(fitted)
    assert abs(first.mean() - second.mean()) < 0.25 * first.std()
    assert second.std() == pytest.approx(first.std(), rel=0.2)
    # The mean log-weight bounds the log of the mean weight from below.
    elbo = fitted.diagnostics["elbo"]
    assert elbo <= float(fitted.log_evidence) + 1e-3
    assert float(fitted.log_evidence) - elbo < 1.0


def test_a_structure_is_for_methods_of_one_structure_only(recorded):
    _, spec, history = recorded
    with pytest.raises(ValueError, match="structure: expected none with method 'smc'"):
        boomdp_jax.infer(jax.random.key(0), spec, history, method="smc", structure={})
    with pytest.raises(ValueError, match=r"method: expected one of .*; got 'mcmc'"):
        boomdp_jax.infer(jax.random.key(0), spec, history, method="mcmc")
