"""Pinned bodies of which nothing tells where the centre of mass is: what is said."""

import dataclasses

import jax.numpy as jnp
import pytest

from boomdp_jax.inference.doubts.lever_doubts import lever_reasons
from boomdp_jax.physics import scene_spec_from_dict
from tests.inference.made_posteriors import table_posterior, table_spec


def scene(*, is_known: bool = False, **changes):
    """A table of which the centre of mass is open, unless it is known."""
    content = table_spec().to_dict() | changes
    if not is_known:
        content["unknown"] = {**content["unknown"], "center_of_mass": True}
    return scene_spec_from_dict(content, source="test")


def reasons_of(spec, *, has_pin: bool = True) -> list[str]:
    posterior = table_posterior()
    params = posterior.params
    num = params.density.shape[0]
    centers = jnp.zeros((num, 1, 2)) if spec.is_center_unknown.any() else None
    pins = params.revolute
    pins = dataclasses.replace(pins, active=pins.active & has_pin)
    params = dataclasses.replace(params, center_of_mass=centers, revolute=pins)
    return lever_reasons(spec, dataclasses.replace(posterior, params=params))


def test_mass_and_centre_of_a_pinned_body_are_not_to_be_relied_on():
    (reason,) = reasons_of(scene())
    assert reason.startswith("table: of a body on a pin only the inertia about that")
    assert "its mass and centre of mass, which cannot be told apart, are not" in reason


def test_with_a_known_mass_the_distance_from_the_pin_shows():
    content = scene().to_dict()
    content["bodies"][0]["density"] = 20.0
    (reason,) = reasons_of(scene_spec_from_dict(content, source="test"))
    assert "its centre of mass, but for its distance from the pin, is not" in reason


@pytest.mark.parametrize(
    ("spec", "has_pin"),
    [
        (scene(is_known=True), True),
        (scene(gravity=[0.0, -9.8]), True),
        (scene(), False),
    ],
    ids=["known", "gravity", "free"],
)
def test_what_can_be_told_is_not_doubted(spec, has_pin):
    assert reasons_of(spec, has_pin=has_pin) == []
