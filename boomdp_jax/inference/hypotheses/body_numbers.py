"""What is inferred of bodies besides densities: where it lies in Φ, and its prior."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.inference.hypotheses.layout import BODY_NUMBERS, BodyNumber, Layout
from boomdp_jax.inference.hypotheses.prior import LOGARITHMIC, PriorScales
from boomdp_jax.physics.params import Actuator, Params

UNASKED = {
    "center_of_mass": 0.0,
    "actuator.gain": 1.0,
    "actuator.bias": 0.0,
    "actuator.delay": 0.0,
}
"""What a body's number is where it is not inferred, but another body's is."""


def get_number(params: Params, name: str) -> Any:
    """A number of all bodies.

    Args:
        params: hypotheses, with any batch axes.
        name: one of `BODY_NUMBERS`.

    Returns:
        Its array, body by body; None where nobody infers it.
    """
    owner: Any = params
    for part in name.split("."):
        owner = None if owner is None else getattr(owner, part)
    return owner


def inferred_numbers(params: Params, prior_params: Params) -> dict[str, tuple]:
    """What is inferred of bodies, by name: draws and prior draws."""
    return {
        name: (get_number(params, name), get_number(prior_params, name))
        for name in BODY_NUMBERS
        if get_number(params, name) is not None
    }


def with_numbers(params: Params, numbers: Mapping[str, Any]) -> Params:
    """Params with numbers of bodies.

    Args:
        params: hypotheses.
        numbers: arrays by name; what is left out stays as it is.
    """
    actuator = {
        name.partition(".")[2]: value
        for name, value in numbers.items()
        if name.startswith("actuator.")
    }
    changes: dict[str, Any] = {}
    if actuator:
        before = params.actuator or Actuator()
        changes["actuator"] = dataclasses.replace(before, **actuator)
    if "center_of_mass" in numbers:
        changes["center_of_mass"] = numbers["center_of_mass"]
    return dataclasses.replace(params, **changes)


def numbers_of(
    z: Float[Array, " dim"],
    layout: Layout,
    scales: PriorScales,
    around: Any,
    gyration: Float[Array, " body"],
) -> dict[str, Array]:
    """Numbers of bodies at coordinates.

    Args:
        z: coordinates of a block.
        layout: what they mean.
        scales: of the prior.
        around: `Surroundings` of the block.
        gyration: squared radii of gyration of its bodies [m²].

    Returns:
        Arrays by name, those that somebody infers.
    """
    arrays: dict[str, Array] = {}
    for number in layout.numbers:
        name, count = number.name, BODY_NUMBERS[number.name]
        origin, unit = number_scale(number, around, gyration)
        part = z[number.start : number.start + count]
        value = origin + unit * scales.scaled(name, part)
        if name in LOGARITHMIC:
            value = jnp.exp(value)
        if name not in arrays:
            arrays[name] = jnp.full((layout.num_bodies, count), UNASKED[name])
        arrays[name] = arrays[name].at[number.body].set(value)
    return {
        name: value if BODY_NUMBERS[name] > 1 else value[:, 0]
        for name, value in arrays.items()
    }


def number_scale(
    number: BodyNumber, around: Any, gyration: Float[Array, " body"]
) -> tuple[Float[Array, " part"], Float[Array, " part"]]:
    """Where a number of a body is measured from, and in multiples of what.

    Args:
        number: which one.
        around: `Surroundings` of its block.
        gyration: squared radii of gyration [m²].

    Returns:
        Origin and unit of each of its parts (zero and one for a logarithm).
    """
    radius = jnp.sqrt(gyration[number.body])
    if number.name == "center_of_mass":
        return around.centroid[number.body], jnp.stack([radius, radius])
    if number.name == "actuator.bias":
        force = around.push[number.body]
        return jnp.zeros(3), jnp.stack([force, force, force * radius])
    return jnp.zeros(1), jnp.ones(1)
