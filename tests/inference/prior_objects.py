"""Objects drawn from the prior, and readings of them drawn from the model itself."""

from typing import Any, NamedTuple

import jax
import numpy as np

from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.blocks.block import make_block, stack_blocks
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit, prior_noise
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict
from boomdp_jax.physics.state import state_from_array
from boomdp_jax.physics.step import step

DT = 0.05
# Spread of the states that steps start from [m, rad, m/s, rad/s], and of the wrenches
# per mass of a body of median density [N/kg, N m/kg].
_STATE = np.array([0.3, 0.3, 1.0, 0.5, 0.5, 1.0])
_WRENCH = np.array([8.0, 8.0, 2.0])


class PriorObjects(NamedTuple):
    """True hypotheses with the targets that their readings make."""

    targets: StructureTarget
    """Stacked along a leading object axis, with the one-step likelihood."""
    structure: np.ndarray
    """`[object]`."""
    z: np.ndarray
    """`[object, dim]`."""
    noise_scale: np.ndarray
    """Sd of what steps end at, of position, angle, velocity and spin, `[object, 4]`."""
    histories: list[History]
    """The readings."""


def box_scene() -> SceneSpec:
    """A box on a floor, that may have a wheel and may rub."""
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, 0.0],
            "dt": DT,
            "bodies": [
                {"name": "box", "shape": {"type": "box", "half_extents": [0.3, 0.2]}}
            ],
            # The prior of a pin's place depends on where the body was seen, which is
            # data: for an exact test only constraints whose prior does not.
            "unknown": {"wheel": 1, "ground": 1},
        },
        source="calibration",
    )


class _Drawn(NamedTuple):
    """All that is random about objects but what their steps end at."""

    targets: StructureTarget
    """Of them only what does not depend on readings is of use."""
    structure: np.ndarray
    z: np.ndarray
    noise_scale: np.ndarray
    state: np.ndarray
    """That steps start from, `[object, row, 1, 6]`."""
    wrench: np.ndarray
    noise: np.ndarray
    """Of what they end at, in sds."""


def draw_objects(
    rng: np.random.Generator, num_objects: int, num_rows: int
) -> PriorObjects:
    """Draw hypotheses from the prior, and readings of single steps given each.

    Every step starts at a state of its own that is known exactly, as the one-step
    likelihood has it; what it ends at is read with noise whose scales follow their
    prior.
    """
    drawn = _draw(rng, num_objects, num_rows)
    truth = _predict(drawn)
    sd = drawn.noise_scale[:, None, None, [0, 0, 1, 2, 2, 3]]
    histories = _histories(drawn.state, drawn.wrench, truth + sd * drawn.noise)
    targets = _stacked(histories)
    return PriorObjects(targets, drawn.structure, drawn.z, drawn.noise_scale, histories)


def _draw(rng: np.random.Generator, num_objects: int, num_rows: int) -> _Drawn:
    state = rng.normal(size=(num_objects, num_rows, 1, 6)) * _STATE
    mass = 30.0 * float(box_scene().scene.area[0])
    wrench = rng.normal(size=(num_objects, num_rows, 1, 3)) * _WRENCH * mass
    targets = _stacked(_histories(state, wrench, state))
    probability = np.exp(np.asarray(targets.log_prior[0], float))
    structure = rng.choice(
        len(probability), size=num_objects, p=probability / probability.sum()
    )
    period = np.asarray(targets.period[0], float)
    turn = period * (rng.random((num_objects, len(period))) - 0.5)
    z = np.where(period > 0, turn, rng.standard_normal(turn.shape))
    slots = np.asarray(targets.structures[0])
    active = np.concatenate([slots, np.ones((len(slots), 1), bool)], axis=1)
    z = np.where(active[:, np.asarray(targets.slot[0])][structure], z, 0.0)
    likelihood: Any = targets.log_likelihood
    scale = np.asarray(likelihood.coordinates.scales.noise, float)[0]
    variance = scale**2 / rng.gamma(1.0, size=(num_objects, 4))
    noise = rng.standard_normal(state.shape)
    return _Drawn(targets, structure, z, np.sqrt(variance), state, wrench, noise)


def _histories(state, wrench, next_state) -> list[History]:
    episode = np.arange(state.shape[1])
    return [
        make_history(s, a, n, DT, episode=episode)
        for s, a, n in zip(state, wrench, next_state, strict=True)
    ]


def _stacked(histories: list[History]) -> StructureTarget:
    spec = box_scene()
    return stack_blocks([make_block(spec, (0,), each) for each in histories])


class PriorTracks(NamedTuple):
    """True hypotheses and noise, and the noisy tracks that they make."""

    targets: StructureTarget
    """Stacked along a leading object axis, with the one-step likelihood."""
    structure: np.ndarray
    """`[object]`."""
    z: np.ndarray
    """`[object, dim]`."""
    noise: NoiseFit
    """Of readings and motion, leading axis `object`."""


def draw_tracks(
    rng: np.random.Generator, num_objects: int, num_rows: int
) -> PriorTracks:
    """Draw hypotheses and noise from the prior, and one noisy track given each.

    States are latent: a body starts somewhere, is kicked before each step and pushed
    during it, and is read once an instant.
    """
    base = _draw(rng, num_objects, num_rows)
    likelihood: Any = base.targets.log_likelihood
    scale = np.asarray(likelihood.coordinates.scales.noise, float)[0]
    reading, impulse = prior_noise(rng, scale, (num_objects, 1))
    spec = box_scene()
    mass = 30.0 * float(spec.scene.area[0])
    shape = (num_objects, num_rows, 1)
    wrench = rng.normal(size=(*shape, 3)) * _WRENCH * mass
    kicks = impulse[:, None, :, [0, 0, 1]] * rng.standard_normal((*shape, 3))
    start = rng.normal(size=(num_objects, 1, 6)) * _STATE
    active = np.asarray(base.targets.structures[0])[base.structure]
    dtype = base.targets.log_prior.dtype
    z, *moved = (np.asarray(x, dtype) for x in (base.z, start, wrench, kicks))
    after = np.asarray(_track_all(likelihood.coordinates, z, active, *moved), float)
    truth = np.concatenate([start[:, None], after], axis=1)
    sd = reading[:, None, :, [0, 0, 1, 2, 2, 3]]
    read = truth + sd * rng.standard_normal(truth.shape)
    blocks = [
        make_block(spec, (0,), make_history(s[:-1], a, s[1:], DT))
        for s, a in zip(read, wrench, strict=True)
    ]
    noise = NoiseFit(reading, impulse)
    return PriorTracks(stack_blocks(blocks), base.structure, base.z, noise)


@jax.jit
def _track_all(coordinates, z, active, start, wrench, kicks):
    def one_object(coordinates, z, active, start, wrenches, kicks):
        params = coordinates(z, active)

        def advance(now, row):
            wrench, kick = row
            kicked = now.at[:, 3:].add(kick)
            now = step(coordinates.scene, params, state_from_array(kicked), wrench)[0]
            return now.array, now.array

        return jax.lax.scan(advance, start, (wrenches, kicks))[1]

    return jax.vmap(one_object)(coordinates, z, active, start, wrench, kicks)


@jax.jit
def _step_all(coordinates, z, active, state, wrench):
    def one_object(coordinates, z, active, states, wrenches):
        params = coordinates(z, active)

        def one_step(state, wrench):
            return step(coordinates.scene, params, state_from_array(state), wrench)[0]

        return jax.vmap(lambda s, w: one_step(s, w).array)(states, wrenches)

    return jax.vmap(one_object)(coordinates, z, active, state, wrench)


def _predict(drawn: _Drawn) -> np.ndarray:
    """Where every step ends, without noise."""
    targets = drawn.targets
    likelihood: Any = targets.log_likelihood
    dtype = targets.log_prior.dtype
    active = np.asarray(targets.structures[0])[drawn.structure]
    given = drawn.z, drawn.state, drawn.wrench
    z, *moved = (np.asarray(x, dtype) for x in given)
    return np.asarray(_step_all(likelihood.coordinates, z, active, *moved), float)
