"""Both ways in which a floor may hold a turn, from either."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.inference.blocks.block import make_block, stack_blocks
from boomdp_jax.inference.fits.find_modes import find_modes
from boomdp_jax.inference.fits.fit import FitSettings, climb, make_fits
from boomdp_jax.inference.fits.floor_starts import with_other_floors
from boomdp_jax.interop.object_families import random_pushes
from boomdp_jax.physics import rollout, scene_spec_from_dict

BOX = {"name": "box", "shape": {"type": "box", "half_extents": [0.3, 0.2]}}
BOX |= {"pose": [0.1, -0.2, 0.3]}
COMMON = {"schema": "planar-scene-1", "dt": 0.02}
FRICTION, MASS = 0.1, 4.8
NOISE = np.array([1e-3, 1e-3, 1e-3, 4e-3, 4e-3, 4e-3])


def pushed(seed: int, num: int = 64):
    """A box that presses evenly, pushed until it slips."""
    floor = {"type": "ground", "a": "box", "dry": FRICTION}
    bodies = [BOX | {"density": 20.0}]
    truth = scene_spec_from_dict({**COMMON, "bodies": bodies, "constraints": [floor]})
    rng = np.random.default_rng(seed)
    force, _ = random_pushes(rng, num, 1, 0.36)
    wrench = 5.0 * MASS * np.asarray(force)[:, None]
    start = truth.initial_state()
    known = truth.scene, truth.params(), start, jnp.asarray(wrench)
    run, _ = jax.jit(rollout)(*known)
    states = np.concatenate([np.asarray(start.array)[None], np.asarray(run.array)])
    states = states + NOISE * rng.normal(size=states.shape)
    return make_history(states[:-1], wrench, states[1:], 0.02)


def targets_of(unknown: dict, seeds=range(4)):
    spec = scene_spec_from_dict({**COMMON, "bodies": [BOX], "unknown": unknown})
    return stack_blocks([make_block(spec, (0,), pushed(seed)) for seed in seeds])


def begun(targets, torque: float, apart: float, friction: float):
    """Where climbs start, one of each object."""
    (slot,) = targets.log_likelihood.coordinates.layout.slots
    scales = targets.log_likelihood.coordinates.scales
    num = len(targets.structures)
    z = np.zeros((num, targets.slot.shape[1]))
    centre, spread = (
        float(part["ground.friction"][0]) for part in (scales.center, scales.spread)
    )
    z[:, slot.start] = (np.log(friction) - centre) / spread
    z[:, slot.start + 2] = torque
    z[:, slot.start + 5 : slot.start + 7] = apart
    structure = np.flatnonzero(np.asarray(targets.structures)[0, :, 0])
    return make_fits(targets, np.arange(num), np.repeat(structure, num), z)


@pytest.mark.slow
def test_the_best_floor_is_found():
    """Best of climbs from all over; without other starts four of twelve were missed."""
    num = 12
    targets = targets_of({"ground": 1}, range(num))
    found = find_modes(jax.random.key(0), targets, FitSettings())
    modes = found.modes
    has_floor = np.asarray(modes.structure) == np.max(modes.structure)
    value = np.where(has_floor, np.asarray(modes.log_density), -np.inf).max(axis=1)
    best = np.full(num, -np.inf)
    for torque, apart, eased in itertools.product((-3, -2, -1, 0), (0, 0.5), (0.85, 1)):
        start = begun(found.targets, torque, apart, eased * FRICTION)
        fits = climb(found.targets, start, 40, is_patient=True)
        best = np.fmax(best, fits.value)
    np.testing.assert_array_less(best - 0.5, value)


@pytest.mark.slow
def test_without_a_floor_there_is_nothing_to_add():
    targets = targets_of({"revolute": 1}, [0])
    num = targets.structures.shape[1]
    z = np.zeros((num, targets.slot.shape[1]))
    fits = make_fits(targets, np.zeros(num, int), np.arange(num), z)
    assert with_other_floors(targets, fits) is fits
