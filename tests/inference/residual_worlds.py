"""Boxes that obey some law: pushed at random, in small steps, and read with noise.

The same law is the same function, so that what was computed of it can be kept.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from boomdp_jax.core.history import History, make_history
from tests.inference.recordings import DT, INERTIA, MASS, NOISE

Force = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""From channels and applied wrench to the whole wrench, world frame [N, N, N m]."""

INVERSE = np.array([1.0 / MASS, 1.0 / MASS, 1.0 / INERTIA])
_SUBSTEPS = 20


def nothing_else(state: np.ndarray, wrench: np.ndarray) -> np.ndarray:
    """A free box."""
    return wrench


@functools.cache
def viscous(coefficient: float) -> Force:
    """Drag in proportion to velocity [N s/m]."""

    def force(state, wrench):
        return wrench - coefficient * np.append(state[3:5], 0.0)

    return force


@functools.cache
def dry(size: float) -> Force:
    """Coulomb friction at the centre of mass [N]."""

    def force(state, wrench):
        speed = np.sqrt(np.sum(state[3:5] ** 2) + 1e-6)
        return wrench - size * np.append(state[3:5] / speed, 0.0)

    return force


@functools.cache
def slope(x: float, y: float) -> Force:
    """A constant force [N]."""

    def force(state, wrench):
        return wrench + np.array([x, y, 0.0])

    return force


@functools.cache
def lever(x: float, y: float) -> Force:
    """Forces act at a point of the body's frame [m], not at its centre of mass."""

    def force(state, wrench):
        cos, sin = np.cos(state[2]), np.sin(state[2])
        arm = np.array([cos * x - sin * y, sin * x + cos * y])
        return wrench + np.array([0.0, 0.0, arm[0] * wrench[1] - arm[1] * wrench[0]])

    return force


@functools.cache
def inertia(ratio: float) -> Force:
    """The same mass with so many times the inertia."""

    def force(state, wrench):
        return wrench * np.array([1.0, 1.0, 1.0 / ratio])

    return force


def record_box(
    rng: np.random.Generator,
    num_rows: int,
    force: Force = nothing_else,
    *,
    dt: np.ndarray | float = DT,
    **options: Any,
) -> History:
    """Readings of a box under random wrenches and a law; options of `box_table`."""
    table = box_table(rng, num_rows, force, dt=dt, **options)
    state, action, next_state = (part[:, None] for part in table)
    return make_history(state, action, next_state, dt)


def box_table(
    rng: np.random.Generator,
    num_rows: int,
    force: Force = nothing_else,
    *,
    noise: np.ndarray = NOISE,
    dt: np.ndarray | float = DT,
    first: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same as arrays `[time, 6]`, `[time, 3]`, `[time, 6]`; midpoint rule."""
    action = rng.normal(size=(num_rows, 3)) * [20.0, 20.0, 3.0]
    path = np.zeros((num_rows + 1, 6))
    path[0] = rng.normal(size=6) * 0.3 if first is None else first
    length = np.broadcast_to(np.asarray(dt), (num_rows,))

    def rate(state, wrench):
        return np.concatenate([state[3:], INVERSE * force(state, wrench)])

    for row in range(num_rows):
        state, part = path[row], length[row] / _SUBSTEPS
        for _ in range(_SUBSTEPS):
            middle = state + 0.5 * part * rate(state, action[row])
            state = state + part * rate(middle, action[row])
        path[row + 1] = state
    path = path + noise * rng.normal(size=path.shape)
    return path[:-1], action, path[1:]
