"""One object's posterior against its truth: errors and intervals, modulo symmetries.

Numbers of a constraint are judged on the draws that have the true structure; mass on
all draws. A wheel is judged by its axle line alone: its place along the axle cannot be
seen where rolling is free.
"""

import dataclasses

import jax
import numpy as np

from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.inference.posteriors.structure_report import (
    Slots,
    axle_offsets,
    constraint_draws,
    group_by_structure,
)
from boomdp_jax.inference.posteriors.summary import axial_difference, weighted_quantiles
from boomdp_jax.physics.params import WORLD, Params
from boomdp_jax.physics.scene_spec import SceneSpec


@dataclasses.dataclass
class ObjectScore:
    """How well one object was understood."""

    family: str
    probability: float
    """Of the true structure."""
    mass_error: float
    """Of the posterior median, relative."""
    mass_bound: float
    """Cramér-Rao bound on the sd of log-mass."""
    errors: dict[str, float] = dataclasses.field(default_factory=dict)
    """Of posterior means, by name; infinite where no draw has the structure."""
    covered: dict[str, bool] = dataclasses.field(default_factory=dict)
    """Whether the central 90 % interval holds the truth, by name."""


def score_object(
    family: str, truth: SceneSpec, posterior: Posterior, mass_bound: float
) -> ObjectScore:
    """Compare a posterior with the truth.

    Args:
        family: what sort of object it is.
        truth: scene with one body, of which everything is known.
        posterior: what was inferred.
        mass_bound: least sd of log-mass that the data allow.

    Returns:
        Errors and coverage of all numbers that the true structure has.
    """
    params = _to_host(posterior.params)
    right = _to_host(truth.params())
    weights = posterior.weights
    slots = tuple(
        Slots(kind, 0, WORLD, 1)
        for kind in ("revolute", "wheel", "ground")
        if np.any(getattr(right, kind).active)
    )
    groups = group_by_structure(params, posterior.inferred, weights)
    found = [group for group in groups if set(group.slots) == set(slots)]
    log_mass = np.log(params.density[:, 0] / right.density[0])
    low, middle, high = _quantiles(log_mass, weights, (0.05, 0.5, 0.95))
    score = ObjectScore(
        family=family,
        probability=found[0].probability if found else 0.0,
        mass_error=float(abs(np.expm1(middle))),
        mass_bound=mass_bound,
    )
    score.covered["mass"] = bool(low <= 0.0 <= high)
    rows = found[0].draws if found else np.zeros(0, int)
    chosen = jax.tree.map(lambda leaf: leaf[rows], params)
    weight = weights[rows] / np.sum(weights[rows])
    for slot in slots:
        draws = {}
        if len(rows):
            _, draws = constraint_draws(slot, chosen, posterior.inferred)
            draws = {key: value[:, 0] for key, value in draws.items()}
        judge = {"revolute": _judge_pin, "wheel": _judge_wheel, "ground": _judge_ground}
        judge[slot.kind](score, draws, weight, right)
    return score


def _judge_pin(
    score: ObjectScore, draws: dict, weight: np.ndarray, right: Params
) -> None:
    for key, place in (("anchor_a", "on the body"), ("anchor_b", "in the world")):
        truth = getattr(right.revolute, key)[0]
        error = np.inf
        if draws:
            error = float(np.hypot(*(weight @ draws[key] - truth)))
        score.errors[f"pin error {place}"] = error
        for axis, name in enumerate("xy"):
            difference = draws[key][:, axis] - truth[axis] if draws else None
            _cover(score, f"pin {name} {place}", difference, weight)


def _judge_wheel(
    score: ObjectScore, draws: dict, weight: np.ndarray, right: Params
) -> None:
    _, truths = constraint_draws(
        Slots("wheel", 0, WORLD, 1),
        jax.tree.map(lambda leaf: leaf[None], right),
        {"wheel": np.ones((1, 1), bool)},
    )
    truth = truths["pose"][0, 0]
    _, true_across = axle_offsets(*truth, truth[2])
    across = turn = None
    if draws:
        x, y, heading = draws["pose"].T
        across = axle_offsets(x, y, heading, truth[2])[1] - true_across
        turn = axial_difference(heading, truth[2])
    score.errors["axle line distance"] = _mean_size(across, weight)
    score.errors["axle angle"] = np.rad2deg(_mean_size(turn, weight))
    _cover(score, "axle line offset", across, weight)
    _cover(score, "wheel heading", turn, weight)


def _judge_ground(
    score: ObjectScore, draws: dict, weight: np.ndarray, right: Params
) -> None:
    ratio = np.log(draws["dry"] / right.ground.dry[0, 0]) if draws else None
    _cover(score, "ground friction", ratio, weight)


def _cover(
    score: ObjectScore, name: str, difference: np.ndarray | None, weight: np.ndarray
) -> None:
    """Whether zero is inside the central 90 % of draws minus truth."""
    is_inside = False
    if difference is not None:
        low, high = _quantiles(difference, weight, (0.05, 0.95))
        is_inside = bool(low <= 0.0 <= high)
    score.covered[name] = is_inside


def _quantiles(
    values: np.ndarray, weight: np.ndarray, levels: tuple[float, ...]
) -> np.ndarray:
    return weighted_quantiles(values[:, None], weight, levels)[:, 0]


def _mean_size(difference: np.ndarray | None, weight: np.ndarray) -> float:
    return np.inf if difference is None else float(abs(weight @ difference))


def _to_host(params: Params) -> Params:
    return jax.tree.map(np.asarray, params)
