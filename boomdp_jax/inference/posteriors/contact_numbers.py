"""Friction and restitution of contact that a scene leaves open: draws and reports."""

import dataclasses
import itertools
from typing import Any

import numpy as np

from boomdp_jax.core.arrays import on_device
from boomdp_jax.inference.blocks.block import Block
from boomdp_jax.inference.hypotheses.prior import LOGARITHMIC, read_prior
from boomdp_jax.inference.posteriors.summary import Scale, summarise
from boomdp_jax.inference.readings.touching import CONTACT_NUMBERS, unknown_contact
from boomdp_jax.physics.params import Params, Surface
from boomdp_jax.physics.scene_arrays import build_surface
from boomdp_jax.physics.scene_spec import SceneSpec

MOST_RATIOS = 15
"""Pairs of bodies whose ratios are reported."""

_SCALES: dict[str, Scale] = {"friction": "log", "restitution": "logit"}


def with_contact_numbers(
    rng: np.random.Generator,
    spec: SceneSpec,
    blocks: list[Block],
    parts: list[Params],
    params: Params,
) -> Params:
    """Draws of a scene with the contact numbers that are inferred.

    Args:
        rng: source of prior draws.
        spec: the scene.
        blocks: of its bodies.
        parts: draws of each.
        params: draws of the whole scene without a surface.

    Returns:
        The same with friction and restitution of every body; a number that is left
        open, and of which no block says anything, is drawn from its prior. The params
        themselves where nothing is left open, or where nothing can touch.
    """
    known, unknown = build_surface(spec.bodies), unknown_contact(spec)
    if known is None or not any(np.any(body) for body in unknown.values()):
        return params
    num_draws, arrays = params.density.shape[0], {}
    for name in CONTACT_NUMBERS:
        values = np.asarray(getattr(known, name))
        values = np.broadcast_to(values, (num_draws, len(values))).copy()
        own = _draws(blocks, parts, name)
        if own is None:
            own = _prior_draws(rng, spec, name, num_draws)
        values[:, unknown[name]] = own[:, None]
        arrays[name] = on_device(values, params.density.dtype)
    return dataclasses.replace(params, surface=Surface(**arrays))


def _draws(blocks: list[Block], parts: list[Params], name: str) -> np.ndarray | None:
    """Draws of a number by the block that depends on it, if there is one."""
    for block, part in zip(blocks, parts, strict=True):
        if name not in block.layout.contact:
            continue
        likelihood: Any = block.target.log_likelihood
        place = np.isnan(np.asarray(getattr(likelihood.coordinates.contact, name)))
        return np.asarray(getattr(part.surface, name))[:, int(np.argmax(place))]
    return None


def _prior_draws(
    rng: np.random.Generator, spec: SceneSpec, name: str, num_draws: int
) -> np.ndarray:
    key = f"contact.{name}"
    scale = read_prior(spec.prior, spec.source).scales[key]
    normal = scale.spread * rng.standard_normal(num_draws)
    if key in LOGARITHMIC:
        return scale.center * np.exp(normal)
    return 1.0 / (1.0 + np.exp(-scale.center - normal))


def report_collisions(
    spec: SceneSpec, params: Params, weights: np.ndarray, prior_params: Params
) -> dict:
    """What a report says of contact, entries with something to say alone.

    Args:
        spec: the scene.
        params: draws, NumPy arrays with a leading draw axis.
        weights: of the draws, sum to one, `[draw]`.
        prior_params: prior draws.

    Returns:
        `contact` and `mass_ratios`, see `report_contact` and `report_mass_ratios`.
    """
    arguments = spec, params, weights, prior_params
    report = {
        "contact": report_contact(*arguments),
        "mass_ratios": report_mass_ratios(*arguments),
    }
    return {name: entry for name, entry in report.items() if entry}


def report_contact(
    spec: SceneSpec, params: Params, weights: np.ndarray, prior_params: Params
) -> dict:
    """What is known of contact numbers that the scene leaves open.

    Args:
        spec: the scene.
        params: draws, NumPy arrays with a leading draw axis.
        weights: of the draws, sum to one, `[draw]`.
        prior_params: prior draws.

    Returns:
        By number (`friction`, `restitution`) a summary, and the `bodies` whose number
        it is; empty where none is inferred.
    """
    if params.surface is None or prior_params.surface is None:
        return {}
    report = {}
    for name, is_open in unknown_contact(spec).items():
        if not is_open.any():
            continue
        place = int(np.argmax(is_open))
        value, prior = (
            np.asarray(getattr(surface, name))[:, place]
            for surface in (params.surface, prior_params.surface)
        )
        names = [spec.names[i] for i in np.flatnonzero(is_open)]
        found = summarise(value, weights, prior, _SCALES[name])
        found["bodies"] = names
        report[name] = found
    return report


def report_mass_ratios(
    spec: SceneSpec, params: Params, weights: np.ndarray, prior_params: Params
) -> list[dict]:
    """Ratios of masses of bodies that can collide.

    A collision without a force tells ratios and no mass: each mass then stays nearly as
    uncertain as before, and neither says how well the ratio is known.

    Args:
        spec: the scene.
        params: draws, NumPy arrays with a leading draw axis.
        weights: of the draws, sum to one, `[draw]`.
        prior_params: prior draws.

    Returns:
        A summary of each pair of bodies of which at least one density is unknown, by
        the order of the scene; empty where nothing collides, or where there are more
        than `MOST_RATIOS` of them.
    """
    movable = [
        index
        for index, body in enumerate(spec.bodies)
        if body.has_contact and not body.is_static
    ]
    pairs = [
        (i, j)
        for i, j in itertools.combinations(movable, 2)
        if spec.bodies[i].density is None or spec.bodies[j].density is None
    ]
    if len(pairs) > MOST_RATIOS:
        return []
    report = []
    for i, j in pairs:
        ratio, prior = (
            _masses(spec, draws, i) / _masses(spec, draws, j)
            for draws in (params, prior_params)
        )
        found = summarise(ratio, weights, prior, "log")
        found["bodies"] = [spec.names[i], spec.names[j]]
        report.append(found)
    return report


def _masses(spec: SceneSpec, draws: Params, index: int) -> np.ndarray:
    """Mass of a body by draw; as the scene has it where it knows the density."""
    body = spec.bodies[index]
    density = np.asarray(draws.density, float)[:, index]
    if body.density is not None:
        density = np.full_like(density, body.density)
    return density * body.area


def untouched_notes(spec: SceneSpec) -> list[str]:
    """What to say of a scene with contact where inference knows none.

    Args:
        spec: the scene.

    Returns:
        One line, or none where nothing can collide.
    """
    colliding = [body for body in spec.bodies if body.has_contact]
    if len(colliding) < 2 or all(body.is_static for body in colliding):
        return []
    names = ", ".join(body.name for body in colliding)
    return [f"contact is left out, as if these never touched: {names}"]
