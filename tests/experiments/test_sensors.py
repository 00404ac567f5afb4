"""What agents are told of their sensors is in the prior, and nothing else changes."""

import dataclasses

import jax.numpy as jnp
import pytest

from boomdp_jax.envs import Cart
from boomdp_jax.experiments.registry import subject_of
from boomdp_jax.experiments.sensors import with_sensors
from boomdp_jax.inference.hypotheses.prior import read_prior


def test_the_prior_is_around_what_sensors_err_but_no_less_than_by_default():
    spec = Cart().spec
    told = with_sensors(spec, jnp.array([0.04, 1e-5, 0.02, 0.04]))
    found = read_prior(told.prior, told.source).noise
    expected = {"position": 0.04, "angle": 1e-3, "velocity": 0.02, "spin": 0.04}
    assert found == pytest.approx(expected)
    for field in dataclasses.fields(spec):
        if field.name != "prior":
            assert getattr(told, field.name) is getattr(spec, field.name)
    assert told.prior["wheel.half_track"] == spec.prior["wheel.half_track"]


def test_nothing_told_is_nothing_changed():
    task = Cart()
    assert with_sensors(task.spec, None) is task.spec
    assert subject_of(task).spec is task.spec
