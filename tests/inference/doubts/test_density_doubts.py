"""Densities far from what is expected, as wrong units of a recording make them."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.inference.doubts.density_doubts import density_reasons
from boomdp_jax.physics import scene_spec_from_dict
from tests.inference.made_posteriors import table_posterior, table_spec


def reasons_of(density: float, *, unit: float = 1.0, **changes) -> list[str]:
    """Of a table that went 0.8 m, read in some unit, and a density [kg/m²]."""
    spec = scene_spec_from_dict(table_spec().to_dict() | changes, source="test")
    state = np.zeros((9, 1, 6))
    state[:, 0, 0] = unit * np.linspace(0.0, 0.8, 9)
    state[4, 0, 0] = np.nan
    history = make_history(state[:-1], np.zeros((8, 1, 3)), state[1:], 0.02)
    posterior = table_posterior()
    params = posterior.params
    spread = np.exp(0.01 * np.random.default_rng(0).standard_normal(1000))
    ours = density * spread[: len(params.density), None]
    params = dataclasses.replace(params, density=jnp.asarray(ours))
    return density_reasons(spec, history, dataclasses.replace(posterior, params=params))


# A cardboard box, a table, a piano, a block of steel that is 0.3 m high.
@pytest.mark.parametrize("density", [2.0, 20.0, 250.0, 2400.0])
def test_what_things_weigh_is_not_doubted(density):
    assert reasons_of(density) == []


def test_a_density_of_no_thing_is_doubted_with_the_units_to_look_at():
    # Pushed by forces in grams, it takes a thousand times as much of them.
    (reason,) = reasons_of(20e3)
    assert reason.startswith("table: a density of 2e+04 kg/m² is 4.3 sds off")
    assert "expected metres, newtons and seconds" in reason
    assert "times its own size" not in reason


@pytest.mark.parametrize(("unit", "density"), [(1e3, 0.02), (1e2, 0.2)])
def test_places_in_millimetres_or_centimetres_are_doubted(unit, density):
    """Accelerations a thousand times too large, by the same forces, far away."""
    (reason,) = reasons_of(density, unit=unit)
    assert f"went {0.8 * unit / np.hypot(0.3, 0.2):.0f} times its own size" in reason


def test_who_expects_such_a_density_is_not_warned_of_it():
    prior = {"density": {"center": 5e3, "spread": 1.5}}
    assert reasons_of(20e3, prior=prior) == []


def test_a_known_density_is_nobodys_guess():
    bodies = table_spec().to_dict()["bodies"]
    bodies = [{**body, "density": 2e4} for body in bodies]
    assert reasons_of(2e4, bodies=bodies) == []
