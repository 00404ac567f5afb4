"""The one coordinate of a body that goes along a line, or turns about a pin."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from boomdp_jax.core.history import History
from boomdp_jax.inference.doubts.told_by_channels import (
    about_pin,
    along_line,
    between,
    spin_about_pin,
)
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.inference.readings.reading_sequence import readings_in_order, scatter
from boomdp_jax.physics.params import WORLD
from boomdp_jax.physics.scene_spec import SceneSpec

# A way is a line if readings scatter across it by so many times the noise, or by this
# share of its length, at most; and is as long as so many times the noise, at least.
_ACROSS, _WIDTH = 3.0, 0.03
_FEWEST = 20
"""Readings of a line."""
# A reading is off if it is so many times as far from its neighbours as they are from
# theirs, or as noise is.
_ODD = 4.0
# Probability of a pin from which the body is taken to turn about it.
_LIKELY = 0.5
# Places that are told hardly worse than usual.
_WHOLE = 1.5


class Way(NamedTuple):
    """One coordinate of a body, at each of its readings, and what acts on it."""

    place: Float[np.ndarray, " reading"]
    speed: Float[np.ndarray, " reading"]
    """NaN where no channel tells it."""
    place_error: Float[np.ndarray, " reading"]
    speed_error: Float[np.ndarray, " reading"]
    """More than the usual where only some of the channels were read."""
    noise: float
    """Usual error of places."""
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
    poses, run = readings.values, readings.run
    values = poses[:, body]
    time, wrench = _after_each(history)
    # What it is tied to may be pushed in its stead.
    others = [i for i in range(wrench.shape[1]) if i != body and not spec.is_static[i]]
    gravity = np.asarray(spec.scene.gravity, float)
    steady = np.ones((len(values), 1))
    ways = []
    arm = _pin_arm(posterior, body)
    turning = scatter(values[:, 2:3], run, is_angle=True, time=time)
    line = _line(values, run, time)
    # Over a short way an arc looks like a line, along which pushes do not do the same.
    if line is not None and arm is not None and turning:
        line = None if turning * np.hypot(*arm) < _ACROSS * line[2] else line
    if line is not None:
        centre, along, noise = line
        place, place_error = along_line(values[:, :2], centre, along, noise)
        pace = _of_speeds(values[:, 3:5], run, time)
        speed, speed_error = along_line(values[:, 3:5], np.zeros(2), along, pace)
        # What is pinned far away goes along a line as well, by torques too, which do
        # as much as it turns on the way.
        torque = wrench[:, body, 2]
        turn = _turn_on_way(_unwrapped(values[:, 2], run), place, run)
        if turn is None:
            force = [wrench[:, body, :2] @ along, steady, torque]
        else:
            force = [wrench[:, body, :2] @ along + turn * torque, steady]
        for other in others:
            force += [wrench[:, other, :2] @ along, wrench[:, other, 2]]
        ways.append(
            Way(
                _without_odd(place, time, run, place_error),
                speed,
                place_error,
                speed_error,
                noise,
                run,
                time,
                _acting(force),
                "the line that it goes along",
            )
        )
    if arm is not None and turning:
        noise = turning
        angle = _unwrapped(values[:, 2], run)
        # A push turns it whether or not its angle was read there.
        nearly = between(angle, run, time)
        cos, sin = np.cos(nearly), np.sin(nearly)
        lever = np.column_stack(
            [cos * arm[0] - sin * arm[1], sin * arm[0] + cos * arm[1]]
        )
        pins = values[:, :2] - lever
        pins[np.isnan(angle)] = np.nan
        is_read = np.all(np.isfinite(pins), axis=1)
        pin = pins[is_read].mean(axis=0) if is_read.any() else np.full(2, np.nan)
        lever = np.nan_to_num(lever)
        (turned, turned_error), arms = about_pin(angle, values[:, :2], run, time, noise)
        pace = _of_speeds(values[:, 5:], run, time)
        spin, spin_error = spin_about_pin(values[:, 5], values[:, 3:5], arms, pace)
        force = [_torque(wrench[:, body], lever), steady]
        if np.any(gravity != 0.0):
            force += [lever]
        for other in others:
            force += [_torque(wrench[:, other], poses[:, other, :2] - pin)]
        ways.append(
            Way(
                _without_odd(turned, time, run, turned_error),
                spin,
                turned_error,
                spin_error,
                noise,
                run,
                time,
                _acting(force),
                "its turn about its pin",
            )
        )
    return ways


def whole_places(way: Way) -> Float[np.ndarray, " reading"]:
    """Places told as well as they usually are, by which ends are told; else NaN."""
    return np.where(way.place_error < _WHOLE * way.noise, way.place, np.nan)


def _turn_on_way(angle: np.ndarray, place: np.ndarray, run: np.ndarray) -> float | None:
    """By how much it turns per length of a line; None where that was not read."""
    is_read = np.isfinite(angle) & np.isfinite(place)
    if is_read.sum() < _FEWEST:
        return None
    # Runs may differ by whole turns.
    apart = (run[is_read, None] == np.unique(run)).astype(float)
    reasons = np.column_stack([place[is_read], apart])
    return float(np.linalg.lstsq(reasons, angle[is_read], rcond=1e-9)[0][0])


def _of_speeds(values: np.ndarray, run: np.ndarray, time: np.ndarray) -> float:
    """Noise of speeds; without bound where too few, or none that differ, were read."""
    return scatter(values, run, time=time) or np.inf


def _line(values: np.ndarray, run: np.ndarray, time: np.ndarray) -> tuple | None:
    """Middle and direction of the line that positions lie on, and their noise."""
    place = values[:, :2]
    noise = scatter(place, run, time=time)
    is_read = np.all(np.isfinite(place), axis=1)
    # Readings that never differ are of what went no way at all.
    if not noise or is_read.sum() < _FEWEST:
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


def _after_each(history: History) -> tuple[np.ndarray, np.ndarray]:
    """Time of each of `readings_in_order`, and the wrenches from there to the next."""
    rows, end = np.flatnonzero(np.asarray(history.mask)), end_of_each(history)
    length = np.zeros(end[-1] + 1)
    length[end] = np.asarray(history.dt, float)[rows]
    wrench = np.zeros((len(length), history.num_bodies, 3))
    wrench[end - 1] = np.asarray(history.action, float)[rows]
    return np.cumsum(length), wrench


def _torque(wrench: np.ndarray, lever: np.ndarray) -> np.ndarray:
    """About a pin that levers are from; as if there were none where they are NaN."""
    turn = lever[:, 0] * wrench[:, 1] - lever[:, 1] * wrench[:, 0]
    return wrench[:, 2] + np.nan_to_num(turn)


def _acting(force: list[np.ndarray]) -> np.ndarray:
    """Side by side, without what never acts."""
    columns = np.column_stack(force)
    return columns[:, np.any(columns != 0.0, axis=0)]


def _without_odd(
    place: np.ndarray, time: np.ndarray, run: np.ndarray, error: np.ndarray
) -> np.ndarray:
    """The same with NaN for a reading that is off while its neighbours are not.

    What bounces is off the line of its neighbours too, but they are then off the lines
    of those beside them; where it does so at the last reading of a run little is lost.
    """
    known = np.flatnonzero(np.isfinite(place))
    q, t, of = place[known], time[known], run[known]

    def off(before: int, after: int) -> np.ndarray:
        """How far each is from the line through two others; NaN: not in its run."""
        out = np.full(len(q), np.nan)
        i = np.arange(max(0, -before), len(q) - after)
        a, c = i + before, i + after
        share = (t[i] - t[a]) / (t[c] - t[a])
        bend = q[i] - q[a] - share * (q[c] - q[a])
        out[i] = np.where(of[a] == of[c], np.abs(bend), np.nan)
        return out

    own = off(-1, 1)
    beside = np.full((2, len(q)), np.nan)
    beside[0, 1:] = off(-1, 2)[:-1]
    beside[1, :-1] = off(-2, 1)[1:]
    most = np.max(np.where(np.isnan(beside), 0.0, beside), axis=0)
    is_told = np.any(np.isfinite(beside), axis=0)
    is_odd = is_told & (own > _ODD * np.maximum(most, error[known]))
    # What begins or ends a run has neighbours on one side.
    new = of[1:] != of[:-1]
    for edge, near, far in (
        (np.flatnonzero(np.append(new, True)), -1, -2),
        (np.flatnonzero(np.append(True, new)), 1, 2),
    ):
        last = edge[(edge + far >= 0) & (edge + far < len(q))]
        bend, before = own[last + near], np.nan_to_num(own[last + far])
        is_far = bend > _ODD * np.maximum(before, error[known][last])
        is_odd[last[is_far & ~is_odd[last + near]]] = True
    out = place.copy()
    out[known[is_odd]] = np.nan
    return out


def _unwrapped(angle: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Without jumps of whole turns from reading to reading."""
    out = angle.copy()
    for each in np.unique(run):
        is_there = (run == each) & np.isfinite(angle)
        out[is_there] = np.unwrap(angle[is_there])
    return out
