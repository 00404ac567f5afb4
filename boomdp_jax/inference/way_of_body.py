"""The one coordinate of a body that goes along a line, or turns about a pin."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from boomdp_jax.core.history import History
from boomdp_jax.inference.posterior import Posterior
from boomdp_jax.inference.reading_sequence import readings_in_order, scatter
from boomdp_jax.physics.params import WORLD
from boomdp_jax.physics.scene_spec import SceneSpec

# A way is a line if readings scatter across it by so many times the noise, or by this
# share of its length, at most; and is as long as so many times the noise, at least.
_ACROSS, _WIDTH = 3.0, 0.03
_FEWEST = 20
"""Readings of a line."""
# Probability of a pin from which the body is taken to turn about it.
_LIKELY = 0.5


class Way(NamedTuple):
    """One coordinate of a body, at each of its readings, and what acts on it."""

    place: Float[np.ndarray, " reading"]
    speed: Float[np.ndarray, " reading"]
    """NaN where it was not read."""
    noise: float
    run: Int[np.ndarray, " reading"]
    time: Float[np.ndarray, " reading"]
    force: Float[np.ndarray, "reading push"]
    """In effect until the next reading: the push first, then what else may act."""
    name: str


def find_ways(
    spec: SceneSpec, history: History, posterior: Posterior, body: int
) -> list[Way]:
    """A line that the body goes along, if it does, and its turn about a pin.

    Args:
        spec: the scene.
        history: readings, a row at least.
        posterior: what was inferred of it; says where pins are.
        body: index of the body.
    """
    readings = readings_in_order(spec, history)
    values, run = readings.values[:, body], readings.run
    time, wrench = _after_each(history, body)
    gravity = np.asarray(spec.scene.gravity, float)
    steady = np.ones((len(values), 1))
    ways = []
    line = _line(values, run)
    if line is not None:
        centre, along, noise = line
        ways.append(
            Way(
                (values[:, :2] - centre) @ along,
                values[:, 3:5] @ along,
                noise,
                run,
                time,
                np.column_stack([wrench[:, :2] @ along, steady]),
                "the line that it goes along",
            )
        )
    arm = _pin_arm(posterior, body)
    noise = scatter(values[:, 2:3], run, is_angle=True)
    if arm is not None and noise is not None:
        angle = _unwrapped(values[:, 2], run)
        cos, sin = np.cos(angle), np.sin(angle)
        lever = np.column_stack(
            [cos * arm[0] - sin * arm[1], sin * arm[0] + cos * arm[1]]
        )
        lever = np.nan_to_num(lever)
        torque = wrench[:, 2] + lever[:, 0] * wrench[:, 1] - lever[:, 1] * wrench[:, 0]
        pull = lever * np.any(gravity != 0.0)
        force = np.column_stack([torque, steady, pull])
        ways.append(
            Way(angle, values[:, 5], noise, run, time, force, "its turn about its pin")
        )
    return ways


def _line(values: np.ndarray, run: np.ndarray) -> tuple | None:
    """Middle and direction of the line that positions lie on, and their noise."""
    place = values[:, :2]
    noise = scatter(place, run)
    is_read = np.all(np.isfinite(place), axis=1)
    if noise is None or is_read.sum() < _FEWEST:
        return None
    centre = place[is_read].mean(axis=0)
    _, size, directions = np.linalg.svd(place[is_read] - centre, full_matrices=False)
    length, width = size / np.sqrt(is_read.sum())
    if width > max(_ACROSS * noise, _WIDTH * length) or length < _ACROSS * noise:
        return None
    return centre, directions[0], noise


def _pin_arm(posterior: Posterior, body: int) -> np.ndarray | None:
    """From the pin to the body's reference point, body frame, where it is pinned."""
    pins = posterior.params.revolute
    if pins is None or pins.active.shape[-1] == 0:
        return None
    first, second = np.asarray(pins.body_a), np.asarray(pins.body_b)
    is_pin = np.asarray(pins.active) & (first == body) & (second == WORLD)
    weight = np.asarray(posterior.weights)[:, None] * is_pin
    if weight.max(axis=1).sum() < _LIKELY:
        return None
    anchor = np.asarray(pins.anchor_a, float)
    return -np.sum(weight[..., None] * anchor, axis=(0, 1)) / weight.sum()


def end_of_each(history: History) -> Int[np.ndarray, " row"]:
    """Which of `readings_in_order` each row ends at; it begins at the one before.

    Args:
        history: readings; rows that are masked have none.
    """
    rows = np.flatnonzero(np.asarray(history.mask))
    begins = ~np.asarray(history.is_chained)[rows]
    return np.arange(len(rows)) + np.cumsum(begins)


def _after_each(history: History, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Time of each of `readings_in_order`, and the wrench from there to the next."""
    rows, end = np.flatnonzero(np.asarray(history.mask)), end_of_each(history)
    length = np.zeros(end[-1] + 1)
    length[end] = np.asarray(history.dt, float)[rows]
    wrench = np.zeros((len(length), 3))
    wrench[end - 1] = np.asarray(history.action, float)[rows, body]
    return np.cumsum(length), wrench


def _unwrapped(angle: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Without jumps of whole turns from reading to reading."""
    out = angle.copy()
    for each in np.unique(run):
        is_there = (run == each) & np.isfinite(angle)
        out[is_there] = np.unwrap(angle[is_there])
    return out
