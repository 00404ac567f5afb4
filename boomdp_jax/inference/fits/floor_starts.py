"""Starts on the other side of the ridge between two ways in which a floor holds a turn.

That a body turns less easily than it slides may be feet that are far apart, or a torque
of its own (`Ground.torque_share`): with a little less friction one looks much like the
other. Optima lie at either, three nats apart of a box that was pushed for 64 steps, and
climbs that start from anywhere end in one of them: of sixteen boxes that press evenly
two had only the torque's, with friction off by thirteen and five per cent, 7.6 and 2.2
of its standard deviations. So the best fits climb once more from the other side.
"""

from typing import Any

import jax
import numpy as np

from boomdp_jax.inference.fits.fit import (
    Fits,
    Host,
    best_of_each,
    climb,
    join_fits,
    make_fits,
)
from boomdp_jax.inference.hypotheses.prior import PriorScales
from boomdp_jax.inference.likelihoods.target import StructureTarget

# Coordinates of a ground slot: of the friction, of the torque's share, and of how far
# apart feet are.
_FRICTION, _TORQUE, _STANCE = 0, 2, (5, 6)
# By how much less friction is with a share of torque, in terms of that share.
_EASED = 0.6
# Coordinates of the torque's share on either side, and of the feet's scale with it.
_SIDES = ((-2.5, 0.0), (0.0, 0.5))
# Structures of a lone body, the best ones; the work grows with the square of the
# number of bodies.
_MOST_STRUCTURES = 4
_NUM_ITERATIONS = 12
_HOPELESS = 40.0


def with_other_floors(targets: StructureTarget, fits: Fits) -> Fits:
    """Add climbs from the other side of the best fits of structures with a floor.

    Args:
        targets: with a `FilteredLikelihood`, stacked along a leading object axis.
        fits: climbed ones, of all structures.

    Returns:
        The same, and what was found; the very fits where no body may have friction.
    """
    likelihood: Any = targets.log_likelihood
    layout = likelihood.coordinates.layout
    slots = [s for s in layout.slots + layout.known_slots if s.kind == "ground"]
    if not slots:
        return fits
    scales = jax.tree.map(np.asarray, likelihood.coordinates.scales)
    num_structures = targets.structures.shape[1]
    host = Host.of(targets)
    top = best_of_each(fits, num_structures, 1)
    value = top.value.reshape(-1, num_structures)
    start = np.array([slot.start for slot in slots])
    has_slot = host.in_use[:, start + _TORQUE]
    ranked = np.where(has_slot.any(axis=1), value, -np.inf)
    most = max(1, _MOST_STRUCTURES // layout.num_bodies**2)
    best = np.argsort(-ranked, axis=1, kind="stable")[:, :most]
    least = value.max(axis=1, keepdims=True) - _HOPELESS
    is_asked = np.take_along_axis(ranked, best, axis=1) > least
    rows = (np.arange(len(value))[:, None] * num_structures + best)[is_asked]
    each, z = [], []
    for place, begin in enumerate(start):
        for torque, apart in _SIDES:
            mine = rows[has_slot[top.structure[rows], place]]
            moved = top.z[mine].copy()
            own = jax.tree.map(lambda leaf, i=top.index[mine]: leaf[i], scales)
            eased = _eased(own, moved[:, begin + _TORQUE])
            change = np.log(eased / _eased(own, np.array(torque)))
            moved[:, begin + _FRICTION] += change / own.spread["ground.friction"]
            moved[:, begin + _TORQUE] = torque
            moved[:, [begin + number for number in _STANCE]] = apart
            each.append(mine)
            z.append(moved)
    mine = np.concatenate(each)
    if not mine.size:
        return fits
    begun = make_fits(targets, top.index[mine], top.structure[mine], np.concatenate(z))
    return join_fits(fits, climb(targets, begun, _NUM_ITERATIONS, is_patient=True))


def _eased(scales: PriorScales, torque: np.ndarray) -> np.ndarray:
    """Friction without a share of torque over that with one, about.

    Args:
        scales: of the prior, of each fit.
        torque: coordinate of the share.
    """
    name = "ground.torque_share"
    center, spread = (np.asarray(part[name]) for part in (scales.center, scales.spread))
    share = center + spread * torque
    return np.asarray(1.0 + _EASED / (1.0 + np.exp(-share)))
