"""Densities far from what is expected, as wrong units of a recording make them."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.inference.doubts.density_doubts import density_reasons
from boomdp_jax.physics import scene_spec_from_dict
from tests.inference.made_posteriors import table_posterior, table_spec


def reasons_of(density: float, **changes) -> list[str]:
    """Of a table of some density [kg/m²]."""
    spec = scene_spec_from_dict(table_spec().to_dict() | changes, source="test")
    posterior = table_posterior()
    params = posterior.params
    spread = np.exp(0.01 * np.random.default_rng(0).standard_normal(1000))
    ours = density * spread[: len(params.density), None]
    params = dataclasses.replace(params, density=jnp.asarray(ours))
    return density_reasons(spec, dataclasses.replace(posterior, params=params))


# Cardboard, a table, a piano, 10 cm of steel and 40 cm.
@pytest.mark.parametrize("density", [0.6, 20.0, 250.0, 785.0, 3140.0])
def test_what_things_weigh_is_not_doubted(density):
    assert reasons_of(density) == []


def test_a_density_of_no_thing_is_doubted_with_the_units_to_look_at():
    # Pushed by forces in grams, it takes a thousand times as much of them.
    (reason,) = reasons_of(20e3)
    assert reason.startswith("table: a density of 2e+04 kg/m² is 4.3 sds off")
    assert "expected metres, newtons and seconds" in reason


@pytest.mark.parametrize("density", [0.02, 0.2])
def test_a_table_read_in_millimetres_or_centimetres_is_doubted(density):
    """The same forces gave accelerations a thousand, or a hundred times too large."""
    assert len(reasons_of(density)) == 1


def test_who_expects_such_a_density_is_not_warned_of_it():
    prior = {"density": {"center": 5e3, "spread": 1.5}}
    assert reasons_of(20e3, prior=prior) == []


def test_a_known_density_is_nobodys_guess():
    bodies = table_spec().to_dict()["bodies"]
    bodies = [{**body, "density": 2e4} for body in bodies]
    assert reasons_of(2e4, bodies=bodies) == []
