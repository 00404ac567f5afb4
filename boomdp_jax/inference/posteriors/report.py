"""The whole posterior as one JSON object."""

from collections.abc import Mapping

import jax
import numpy as np
from jaxtyping import Array

from boomdp_jax.inference.hypotheses.prior import LOGARITHMIC
from boomdp_jax.inference.posteriors.structure_report import (
    group_by_structure,
    report_slots,
    structure_name,
)
from boomdp_jax.inference.posteriors.summary import CHANNELS, IMPULSES, summarise
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene_spec import SceneSpec

SCHEMA = "boomdp-infer-1"


def report_bodies(
    spec: SceneSpec,
    density: np.ndarray,
    weights: np.ndarray,
    prior_density: np.ndarray,
    numbers: Mapping[str, tuple[np.ndarray, np.ndarray]] | None = None,
) -> dict:
    """Density [kg/m²] and mass [kg] of every body that can move, by name.

    A density that the scene file gives counts as identified. `numbers` are told beside
    them, a centre of mass in the frame of the outline as authored [m].

    Args:
        spec: the scene.
        density: draws, `[draw, body]`.
        weights: of the draws, sum to one, `[draw]`.
        prior_density: prior draws, `[draw, body]`.
        numbers: by name of `BODY_NUMBERS`, draws and prior draws of what else is
            inferred, `[draw, body, ...]`.

    Returns:
        Marginal summaries over structure, and `identified`, which is the mass's.
    """
    report = {}
    for index, body in enumerate(spec.bodies):
        if body.is_static:
            continue
        prior = prior_density[:, index]
        if body.density is not None:
            prior = np.full(1, body.density)
        value = density[:, index]
        mass = summarise(value * body.area, weights, prior * body.area, "log")
        report[body.name] = {
            "density": summarise(value, weights, prior, "log"),
            "mass": mass,
            "identified": mass["identified"],
        }
        for name, (draws, prior_draws) in (numbers or {}).items():
            if np.all(prior_draws[:, index] == prior_draws[0, index]):
                continue
            shift = body.shift if name == "center_of_mass" else 0.0
            report[body.name][name] = summarise(
                draws[:, index] + shift,
                weights,
                prior_draws[:, index] + shift,
                "log" if name in LOGARITHMIC else "identity",
            )
    return report


def report_noise(
    spec: SceneSpec,
    noise_scale: np.ndarray,
    weights: np.ndarray,
    prior_noise_scale: np.ndarray,
    impulse_scale: np.ndarray | None = None,
    prior_impulse_scale: np.ndarray | None = None,
) -> dict:
    """Noise sd of every body's readings, and of its motion.

    Args:
        spec: the scene.
        noise_scale: draws, `[draw, body, 4]` [m, rad, m/s, rad/s].
        weights: of the draws, sum to one, `[draw]`.
        prior_noise_scale: prior draws, like `noise_scale`.
        impulse_scale: draws of the motion's noise, `[draw, body, 2]` [m/s, rad/s].
        prior_impulse_scale: prior draws of it.

    Returns:
        By name of each body that can move, then by channel (position, angle, velocity,
        spin; velocity and spin impulse), a summary.
    """
    channels = CHANNELS
    if impulse_scale is not None and prior_impulse_scale is not None:
        channels = (*CHANNELS, *IMPULSES)
        noise_scale = np.concatenate([noise_scale, impulse_scale], axis=-1)
        prior_noise_scale = np.concatenate(
            [prior_noise_scale, prior_impulse_scale], axis=-1
        )
    return {
        body.name: {
            name: summarise(
                noise_scale[:, index, channel],
                weights,
                prior_noise_scale[:, index, channel],
                "log",
            )
            for channel, name in enumerate(channels)
        }
        for index, body in enumerate(spec.bodies)
        if not body.is_static
    }


def report_structures(
    spec: SceneSpec,
    params: Params,
    weights: np.ndarray,
    prior_params: Params,
    inferred: Mapping[str, np.ndarray],
) -> list[dict]:
    """Structures of the whole scene, most probable first, with their numbers.

    Args:
        spec: the scene.
        params: draws, NumPy arrays with a leading draw axis.
        weights: of the draws, sum to one, `[draw]`.
        prior_params: prior draws with every inferable slot active.
        inferred: by kind, which slots are inferred rather than known.

    Returns:
        `probability` and `constraints` of each; a constraint's numbers come from the
        draws that have this structure.
    """
    shift, names = _shift(spec), tuple(spec.names)
    report = []
    for slots, probability, draws in group_by_structure(params, inferred, weights):
        if probability <= 0:
            continue
        chosen = jax.tree.map(lambda leaf, draws=draws: leaf[draws], params)
        weight = weights[draws] / weights[draws].sum()
        constraints = []
        for like in slots:
            constraints += report_slots(
                like, chosen, weight, inferred, prior_params, shift, names
            )
        report.append({"probability": probability, "constraints": constraints})
    return report


def report_known(
    spec: SceneSpec,
    params: Params,
    weights: np.ndarray,
    prior_params: Params,
    inferred: Mapping[str, np.ndarray],
) -> list[dict]:
    """Constraints that are known to exist and have a number that is inferred.

    Args and entries are those of `report_structures`.
    """
    known = {kind: ~slots for kind, slots in inferred.items()}
    shift, names = _shift(spec), tuple(spec.names)
    report = []
    for slots, _, _ in group_by_structure(params, known, weights)[:1]:
        for like in slots:
            report += report_slots(
                like, params, weights, known, prior_params, shift, names
            )
    return [entry for entry in report if _has_spread(entry)]


def structure_probabilities(
    spec: SceneSpec,
    params: Params,
    weights: np.ndarray,
    inferred: Mapping[str, np.ndarray],
) -> dict[str, float]:
    """Probability of each structure by its readable name, most probable first."""
    names = _moving_names(spec)
    result: dict[str, float] = {}
    for slots, probability, _ in group_by_structure(params, inferred, weights):
        name = structure_name(slots, tuple(spec.names), is_single=len(names) == 1)
        result[name] = result.get(name, 0.0) + probability
    return result


def _shift(spec: SceneSpec) -> np.ndarray:
    return np.array([body.shift for body in spec.bodies]).reshape(-1, 2)


def _moving_names(spec: SceneSpec) -> list[str]:
    return [body.name for body in spec.bodies if not body.is_static]


def _has_spread(entry: dict) -> bool:
    """Whether any number of a constraint varies over the draws."""
    spreads = [
        np.ravel(item["sd"]) for item in entry.values() if isinstance(item, dict)
    ]
    return any(sd is not None and sd > 0 for each in spreads for sd in each)


def doubled(array: Array | None) -> np.ndarray | None:
    """On the host in double precision."""
    return None if array is None else np.asarray(array, np.float64)


def on_host(params: Params) -> Params:
    """Params as NumPy arrays, floats in double precision."""

    def convert(leaf: Array) -> np.ndarray:
        array = np.asarray(leaf)
        return array.astype(np.float64) if array.dtype.kind == "f" else array

    return jax.tree.map(convert, params)
