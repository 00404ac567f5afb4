"""Objects whose readings are noisy and whose motion is: recordings, bounds and rivals.

Noise is stated as a share of each channel's own standard deviation over a recording.
The motion's noise is an impulse on the twist before each step.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _information import PRIOR_SD, free_numbers

from boomdp_jax.core.transition_table import TransitionTable
from boomdp_jax.inference.likelihoods.kalman import NoiseLevel, extended_filter
from boomdp_jax.inference.likelihoods.tracking import Gains, innovations, one_step_gains
from boomdp_jax.inference.posteriors.summary import axial_difference
from boomdp_jax.inference.readings.track_data import TrackData, track_data
from boomdp_jax.interop.object_families import random_object, record_random_pushes
from boomdp_jax.interop.recording import with_reading_noise
from boomdp_jax.physics import Params, Scene, State, step
from boomdp_jax.physics.scene_spec import SceneSpec

GROUPS = ((0, 1), (2,), (3, 4), (5,))
_CHANNEL = np.array([0, 0, 1, 2, 2, 3])
# A motion without noise is filtered with this little, in units of the reading's.
_LEAST_IMPULSE = 1e-4


class NoisyObject(NamedTuple):
    """One object and what was read of it."""

    family: str
    truth: SceneSpec
    table: TransitionTable
    """Noisy."""
    reading: np.ndarray
    """Sd of position, angle, velocity and spin readings, `[4]`."""
    impulse: np.ndarray
    """Sd of the kicks of velocity and spin before each step, `[2]`."""


def make_noisy_object(
    seed: list[int], family: str, num_rows: int, reading: float, process: float
) -> NoisyObject:
    """Push a random object, its motion disturbed, and read it badly.

    Args:
        seed: of everything.
        family: see `object_families`.
        num_rows: transitions, in four episodes.
        reading: noise of a reading, a share of its channel's standard deviation.
        process: the same of the kicks on velocity and spin.
    """
    rng = np.random.default_rng(seed)
    truth = random_object(rng, family)
    table = record_random_pushes(rng, truth, num_rows)
    spread = _channel_spread(table)
    table = _disturbed(rng, truth, table, process * spread[2:])
    spread = _channel_spread(table)
    noisy = with_reading_noise(rng, table, tuple(reading * spread))
    return NoisyObject(family, truth, noisy, reading * spread, process * spread[2:])


def _channel_spread(table: TransitionTable) -> np.ndarray:
    """Sd of position, angle, velocity and spin over a recording."""
    values = table.next_state[:, 0]
    return np.array([np.sqrt(np.mean(np.var(values[:, g], axis=0))) for g in GROUPS])


def _disturbed(
    rng, truth: SceneSpec, table: TransitionTable, impulse
) -> TransitionTable:
    """The same pushes from the same starts, with kicks, in our engine."""
    kicks = rng.standard_normal((table.num_rows, 3)) * impulse[[0, 0, 1]]
    starts = np.diff(table.episode, prepend=-1) != 0
    with jax.enable_x64(True):
        before, after = _roll(
            truth.scene,
            truth.params(),
            jnp.asarray(table.state[:, 0], float),
            jnp.asarray(starts),
            jnp.asarray(table.action[:, 0], float),
            jnp.asarray(kicks),
        )
    return dataclasses.replace(
        table, state=np.asarray(before)[:, None], next_state=np.asarray(after)[:, None]
    )


@jax.jit
def _roll(scene: Scene, params: Params, first, is_start, wrenches, kicks):
    def advance(state, row):
        first, is_start, wrench, kick = row
        state = jnp.where(is_start, first, state)
        kicked = state.at[3:].add(kick)[None]
        after, _ = step(
            scene, params, State(kicked[:, :3], kicked[:, 3:]), wrench[None]
        )
        return after.array[0], (state, after.array[0])

    rows = (first, is_start, wrenches, kicks)
    return jax.lax.scan(advance, jnp.zeros(6), rows)[1]


class Estimate(NamedTuple):
    """A guess of an object's free numbers, as offsets from the truth."""

    offset: np.ndarray
    covariance: np.ndarray


class Bounds(NamedTuple):
    """The least covariance of an object's free numbers, and what rivals make of it."""

    covariance: np.ndarray
    """Cramér-Rao bound: that of the extended filter at the truth."""
    rivals: dict[str, Estimate]
    """One-step and open-loop least squares, started at the truth, with scales of the
    residuals of their own."""


def bounds_and_rivals(item: NoisyObject) -> Bounds:
    """Structure and noise are known to the bound; the structure to the rivals."""
    with jax.enable_x64(True):
        data = track_data(item.table.to_history(), (0,), True)
        data = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), data)
        impulse = np.maximum(item.impulse, _LEAST_IMPULSE * item.reading[2:])
        noise = NoiseLevel(jnp.asarray(item.reading)[None], jnp.asarray(impulse)[None])
        scene, params = item.truth.scene, item.truth.params()
        gains = _true_gains(scene, params, data, noise)
        ones = one_step_gains(data, item.reading[_CHANNEL][None])
        ones = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), ones)
        never = eqx.tree_at(lambda g: g.first, ones, jnp.zeros_like(ones.first))
        return Bounds(
            np.asarray(_bound(scene, params, data, gains)),
            {
                "one-step": _least_squares(scene, params, data, ones),
                "open-loop": _least_squares(scene, params, data, never),
            },
        )


class Quantity(NamedTuple):
    """A number that an object is judged by."""

    name: str
    direction: np.ndarray
    """How it depends on offsets of the free numbers."""


def quantities(item: NoisyObject) -> list[Quantity]:
    """Mass, pin and wheel, in the order of `_information.free_numbers`.

    A wheel's place counts across its axle only, along which it can slide unseen.
    """
    params = jax.tree.map(np.asarray, item.truth.params())
    num = len(free_numbers(params)[0])
    unit = np.eye(num)
    out = [Quantity("log mass", unit[0])]
    if item.family == "table":
        names = ("pin x on the body", "pin y on the body", "pin x in the world")
        names = (*names, "pin y in the world")
        out += [Quantity(name, unit[1 + i]) for i, name in enumerate(names)]
    if item.family == "cart":
        heading = float(params.wheel.heading[0, 0])
        along = np.cos(heading) * unit[1] + np.sin(heading) * unit[2]
        out += [
            Quantity("axle line offset", along),
            Quantity("wheel heading", unit[3]),
            Quantity("log rolling friction", unit[4]),
            Quantity("log lateral friction", unit[5]),
        ]
    return out


def offsets_of_draws(item: NoisyObject, params: Params) -> np.ndarray:
    """Draws of the object's own structure as offsets from the truth.

    Args:
        item: the object.
        params: draws on the host, leading axis draw, that have the true structure.

    Returns:
        `[draw, number]`, columns as in `quantities`; those that no quantity uses are
        zero.
    """
    truth = jax.tree.map(np.asarray, item.truth.params())
    out = np.zeros((len(params.density), len(free_numbers(truth)[0])))
    out[:, 0] = np.log(params.density[:, 0] / truth.density[0])
    if item.family == "table":
        out[:, 1:3] = params.revolute.anchor_a[:, 0] - truth.revolute.anchor_a[0]
        out[:, 3:5] = params.revolute.anchor_b[:, 0] - truth.revolute.anchor_b[0]
    if item.family == "cart":
        wheel, right = params.wheel, truth.wheel
        out[:, 1:3] = wheel.position[:, 0, 0] - right.position[0, 0]
        out[:, 3] = axial_difference(wheel.heading[:, 0, 0], right.heading[0, 0])
        viscous, least = wheel.viscous[:, 0, 0], np.finfo(np.float32).tiny
        out[:, 4:6] = np.log(np.maximum(viscous, least) / right.viscous[0, 0])
    return out


@jax.jit
def _true_gains(scene, params, data: TrackData, noise: NoiseLevel) -> Gains:
    return extended_filter(scene, params, data, noise).gains


def _residual(scene, params, data, gains):
    _, base = free_numbers(params)
    return lambda free: innovations(scene, base(free), data, gains).reshape(-1)


@jax.jit
def _bound(scene, params, data, gains):
    kinds, _ = free_numbers(params)
    jacobian = jax.jacfwd(_residual(scene, params, data, gains))(jnp.zeros(len(kinds)))
    prior = jnp.diag(jnp.array([PRIOR_SD[kind] ** -2 for kind in kinds]))
    return jnp.linalg.inv(jacobian.T @ jacobian + prior)


@jax.jit
def _normal_equations(scene, params, data, gains, free):
    """Gauss-Newton with every channel group weighed by its own residuals."""
    residual = _residual(scene, params, data, gains)
    value = residual(free)
    jacobian = jax.jacfwd(residual)(free)
    table = value.reshape(-1, 6)
    group = jnp.asarray(_CHANNEL)
    counts = jnp.sum(gains.counts.reshape(-1, 6), axis=0)
    num = jax.ops.segment_sum(counts, group, 4)
    square = jax.ops.segment_sum(jnp.sum(table**2, axis=0), group, 4)
    weight = jnp.tile((num / jnp.maximum(square, 1e-30))[group], table.shape[0])
    kinds, _ = free_numbers(params)
    prior = jnp.array([PRIOR_SD[kind] ** -2 for kind in kinds])
    matrix = (jacobian.T * weight) @ jacobian + jnp.diag(prior)
    gradient = jacobian.T @ (weight * value) + prior * free
    return matrix, gradient, 0.5 * jnp.sum(num * jnp.log(square + 1e-30))


def _least_squares(scene, params, data, gains) -> Estimate:
    kinds, _ = free_numbers(params)
    free, damping = jnp.zeros(len(kinds)), 1e-3
    matrix, gradient, cost = _normal_equations(scene, params, data, gains, free)
    prior = np.array([PRIOR_SD[kind] ** -2 for kind in kinds])
    for _ in range(30):
        damped = matrix + damping * jnp.diag(jnp.diagonal(matrix))
        trial = free - jnp.linalg.solve(damped, gradient)
        found = _normal_equations(scene, params, data, gains, trial)
        gain = cost + 0.5 * prior @ free**2 - found[2] - 0.5 * prior @ trial**2
        if np.isfinite(gain) and gain > 0:
            free, (matrix, gradient, cost), damping = trial, found, damping / 5
            if gain < 1e-6:
                break
        else:
            damping *= 5
    return Estimate(np.asarray(free), np.linalg.inv(np.asarray(matrix)))
