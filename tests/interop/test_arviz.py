"""ArviZ sees chains, names and numbers as they are."""

import importlib

import numpy as np
import pytest

from boomdp_jax.interop.arviz import to_arviz
from tests.inference.made_posteriors import table_posterior


@pytest.fixture(scope="module")
def converted():
    return table_posterior(40).to_arviz()


def test_chains_and_names_are_dimensions(converted):
    mass = converted["posterior"]["mass"]
    assert dict(mass.sizes) == {"chain": 2, "draw": 20, "body": 1}
    assert list(mass.coords["body"].values) == ["table"]
    viscous = converted["posterior"]["wheel_viscous"]
    assert viscous.dims == ("chain", "draw", "body", "wheel", "direction")
    assert list(viscous.coords["direction"].values) == ["rolling", "lateral"]
    noise = converted["posterior"]["noise_scale"]
    assert list(noise.coords["channel"].values) == [
        "position",
        "angle",
        "velocity",
        "spin",
    ]


def test_numbers_are_the_draws(converted):
    posterior = table_posterior(40)
    density = np.asarray(posterior.params.density)[:, 0]
    ours = converted["posterior"]["density"].values[..., 0]
    np.testing.assert_array_equal(ours.reshape(-1), density)
    lp = converted["sample_stats"]["lp"].values.reshape(-1)
    np.testing.assert_array_equal(lp, np.asarray(posterior.log_density))
    assert converted["prior"]["density"].shape == (1, 500, 1)


def test_numbers_of_absent_constraints_are_nan(converted):
    active = converted["posterior"]["wheel_active"].values
    heading = converted["posterior"]["wheel_heading"].values
    np.testing.assert_array_equal(np.isnan(heading), ~active)


def test_unequal_weights_are_resampled_into_one_chain():
    weights = np.where(np.arange(400) % 4 == 0, 9.0, 1.0)
    converted = to_arviz(table_posterior(400, weights=weights))
    active = converted["posterior"]["wheel_active"]
    assert active.shape[:2] == (1, 400)
    # Five standard errors of independent draws; strata only lower it.
    assert float(active.mean()) == pytest.approx(
        0.75, abs=5 * (0.75 * 0.25 / 400) ** 0.5
    )


def test_without_arviz_the_message_says_what_to_install(monkeypatch):
    real = importlib.import_module

    def refuse(name, *rest):
        if name == "arviz":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(importlib, "import_module", refuse)
    with pytest.raises(ImportError, match=r"pip install 'boomdp_jax\[arviz\]'"):
        to_arviz(table_posterior(10))
