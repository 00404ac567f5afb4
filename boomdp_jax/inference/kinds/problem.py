"""Bodies that were sampled alone, set up as objects of a mixture over kinds."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.arrays import on_device
from boomdp_jax.inference.blocks.block import Block
from boomdp_jax.inference.hypotheses.coordinates import Coordinates
from boomdp_jax.inference.hypotheses.layout import Layout
from boomdp_jax.inference.hypotheses.meeting import met_at, rod_length
from boomdp_jax.inference.kinds.coordinates import CoordinateModel
from boomdp_jax.inference.kinds.objects import ObjectsAlone
from boomdp_jax.inference.kinds.prior import KindPrior
from boomdp_jax.inference.kinds.state import KindData
from boomdp_jax.physics.params import WORLD

PLACE_COORDINATES = {
    "revolute": (2, 3),
    "distance": (2, 3, 4),
    "prismatic": (1, 2),
    "weld": (0, 1, 2),
}
"""Coordinates of a joint to the world that belong to where the body stands and not to
its kind, by their place in the slot; of a kind of constraint that is not listed: none.
"""


def kind_data(
    objects: ObjectsAlone,
    label: np.ndarray,
    num_labels: int,
    feature: np.ndarray,
    prior: KindPrior,
) -> KindData:
    """What the sampler of kinds needs.

    Args:
        objects: bodies sampled alone.
        label: number of each body's label, -1: none.
        num_labels: how many labels there are.
        feature: of each body's outline, `[body, feature]`; none: no features.
        prior: of kinds.

    Returns:
        The data.
    """
    block = objects.bodies[0].block
    target: Any = block.target
    return KindData(
        coordinates=coordinate_model(block.layout, feature.shape[1], prior),
        in_use=structures_in_use(block),
        log_prior=np.asarray(target.log_prior, float),
        bumps=tuple(body.bumps for body in objects.bodies),
        label=label,
        num_labels=num_labels,
        feature=feature,
        log_likelihood=objects.log_likelihood,
        prior=prior,
    )


def structures_in_use(block: Block) -> np.ndarray:
    """Coordinates that each structure uses, `[structure, dim]`."""
    slot = block.layout.slot_of_coordinate()
    rows = np.asarray(block.target.structures)
    return np.append(rows, np.ones((len(rows), 1), bool), axis=1)[:, slot]


def coordinate_model(
    layout: Layout, num_features: int, prior: KindPrior
) -> CoordinateModel:
    """Which coordinates objects of a kind share, and how closely.

    Args:
        layout: of one body.
        num_features: of outlines.
        prior: of kinds.
    """
    period = layout.period()
    spread = np.tile(prior.spreads, (layout.dim, 1))
    # An angle's prior has no sd; one of a radian, cut to the period, stands for it.
    is_angle = period > 0
    spread[is_angle] *= period[is_angle, None] / np.pi
    spread[is_angle[:, None] & (np.array(prior.spreads) == 1.0)] = np.inf
    for slot in layout.slots + layout.known_slots:
        if slot.body_b == WORLD:
            for place in PLACE_COORDINATES.get(slot.kind, ()):
                index = slot.start + place
                spread[index] = np.inf if is_angle[index] else 1.0
    log_weight = np.tile(_log_shares(prior.weights), (layout.dim, 1))
    num = max(len(prior.spreads), len(prior.outline_spreads))
    features = np.tile(prior.outline_spreads, (num_features, 1))
    feature_weight = np.tile(_log_shares(prior.outline_weights), (num_features, 1))
    return CoordinateModel(
        period=np.concatenate([period, np.zeros(num_features)]),
        spread=np.concatenate([_pad(spread, num, 1.0), _pad(features, num, 1.0)]),
        log_weight=np.concatenate(
            [_pad(log_weight, num, -np.inf), _pad(feature_weight, num, -np.inf)]
        ),
    )


def settle(
    coordinates: Coordinates, z: np.ndarray, pose: np.ndarray | None
) -> np.ndarray:
    """Put joints to the world where a resting body stands.

    Where in the world a pin is follows from where it is on the body and from how the
    body lies. Of a body that never moved that is all there is to know of it.

    Args:
        coordinates: of the body.
        z: coordinates of draws, `[draw, dim]`.
        pose: of its centre of mass [m, m, rad]; None: not known, nothing changes.

    Returns:
        The same with other coordinates of the place.
    """
    if pose is None:
        return z
    layout, scales = coordinates.layout, coordinates.scales
    around = coordinates.surroundings
    radius, reach = around.radius[0], around.radius[0] + around.spread[0]
    stood = on_device([*pose[:2], np.cos(pose[2]), np.sin(pose[2])])

    def settled(row):
        for slot, frame in zip(layout.meetings, around.meeting, strict=True):
            if slot.body_b != WORLD:
                continue
            own, start = row[slot.start :], slot.start
            first = reach * scales.scaled(f"{slot.kind}.anchor", own[0:2])
            if slot.kind == "revolute":
                off = (met_at(stood, first) - met_at(frame, first)) / radius
                place = jnp.arcsinh(scales.standard("revolute.offset", off))
                row = row.at[start + 2 : start + 4].set(place)
            else:
                second = (
                    reach * scales.scaled("distance.anchor", own[2:4])
                    + around.center[0]
                )
                now = rod_length(stood, first, second, radius)
                ratio = jnp.log(now / rod_length(frame, first, second, radius))
                row = row.at[start + 4].set(scales.standard("distance.length", ratio))
        for slot in layout.rests:
            for place in PLACE_COORDINATES[slot.kind]:
                is_angle = place == 2
                name = f"{slot.kind}.{'angle' if is_angle else 'offset'}"
                value = jnp.arcsinh(scales.standard(name, jnp.zeros(())))
                row = row.at[slot.start + place].set(value)
        return row

    return np.array(jax.vmap(settled)(on_device(z)), float)


def _log_shares(weights: tuple[float, ...]) -> np.ndarray:
    return np.log(np.array(weights) / np.sum(weights))


def _pad(array: np.ndarray, num: int, value: float) -> np.ndarray:
    width = [(0, 0), (0, num - array.shape[1])]
    return np.pad(array, width, constant_values=value)
