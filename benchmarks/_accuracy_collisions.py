"""Scenes of contact: two balls, a ball and a box, a row of balls, a stack of boxes."""

import itertools

import _repository  # noqa: F401
import numpy as np
from _accuracy_case import (
    DT,
    GRAVITY,
    Case,
    ball,
    box,
    place_error,
    scene,
    velocity_error,
)
from _overlap import deepest_overlap
from _peers_program import Figure

from tests.reference import collisions

DENSITY = 20.0
RADII = (0.2, 0.3)
NUM_BALLS, CRADLE_RADIUS, CRADLE_GAP, CRADLE_SPEED = 5, 0.1, 1e-3, 2.0
NUM_STACKED, STACKED = 5, (0.2, 0.1)


def collision_cases() -> list[Case]:
    """Scenes that contact decides.

    Returns:
        The cases, each with its reference.
    """
    pairs = itertools.product((("head-on", 0.0), ("oblique", 0.25)), (0.0, 0.5, 1.0))
    balls = [_two_balls(name, offset, e) for (name, offset), e in pairs]
    return [*balls, _ball_on_box(), _cradle(), _stack()]


def _surface(friction: float, restitution: float) -> dict:
    return {"contact": {"friction": friction, "restitution": restitution}}


def _two_balls(name: str, offset: float, restitution: float) -> Case:
    num_steps = 60
    start = np.zeros((2, 6))
    start[1, :2] = 1.0, offset
    start[:, 3] = 2.0, -1.0
    surface = _surface(0.0, restitution)
    spec = scene(
        [
            ball(f"ball {i}", RADII[i], start[i], density=DENSITY, **surface)
            for i in range(2)
        ]
    )
    end = collisions.two_balls(RADII, DENSITY, start, restitution, DT * num_steps)

    def judge(states):
        return [velocity_error(states[-1], end), place_error(states[-1], end)]

    title = f"two balls, {name}, restitution {restitution:g}"
    return Case(title, spec, num_steps, judge, in_quick=restitution == 0.5)


def _ball_on_box() -> Case:
    """A ball hits the left face of a box off its centre."""
    restitution, num_steps, radius = 0.5, 30, 0.15
    height, speed = 0.15, 3.0
    half_width, half_height = 0.2, 0.3
    surface = _surface(0.0, restitution)
    start = np.zeros((2, 6))
    start[0, :2], start[0, 3] = (-1.0, height), speed
    spec = scene(
        [
            ball("ball", radius, start[0], density=DENSITY, **surface),
            box("box", (half_width, half_height), density=DENSITY, **surface),
        ]
    )
    first = (1.0 - half_width - radius) / speed
    mass = DENSITY * np.array([np.pi * radius**2, 4.0 * half_width * half_height])
    gyration = [0.5 * radius**2, (half_width**2 + half_height**2) / 3.0]
    arm = [[radius, 0.0], [-half_width, height]]
    twist = collisions.impact(
        mass, mass * gyration, start[:, 3:], arm, [1.0, 0.0], restitution
    )
    pose = start[:, :3] + first * start[:, 3:] + (DT * num_steps - first) * twist
    end = np.concatenate([pose, twist], axis=1)

    def judge(states):
        spin = abs(float(states[-1, 1, 5] - end[1, 5]))
        return [
            velocity_error(states[-1], end),
            Figure("spin of the box", spin, "rad/s"),
            place_error(states[-1], end),
        ]

    return Case("ball on box, restitution 0.5", spec, num_steps, judge)


def _cradle() -> Case:
    num_steps = 60
    pitch = 2.0 * CRADLE_RADIUS + CRADLE_GAP
    start = np.zeros((NUM_BALLS, 6))
    start[:, 0] = pitch * np.arange(NUM_BALLS)
    start[0, 0], start[0, 3] = -0.5, CRADLE_SPEED
    surface = _surface(0.0, 1.0)
    spec = scene(
        [
            ball(f"ball {i}", CRADLE_RADIUS, state, density=DENSITY, **surface)
            for i, state in enumerate(start)
        ]
    )
    end = np.zeros((NUM_BALLS, 6))
    end[:, 0], end[:, 3] = collisions.row_of_balls(
        start[:, 0], start[:, 3], 2.0 * CRADLE_RADIUS, DT * num_steps
    )

    def judge(states):
        energy = np.sum(states[-1, :, 3:5] ** 2) / CRADLE_SPEED**2
        return [
            velocity_error(states[-1], end),
            place_error(states[-1], end),
            Figure("energy gained", 100.0 * float(energy - 1.0), "%"),
        ]

    title = "cradle of five balls, gaps of 1 mm"
    return Case(title, spec, num_steps, judge, in_quick=False)


def _stack() -> Case:
    num_steps = 600
    surface = _surface(0.5, 0.0)
    start = np.zeros((NUM_STACKED, 6))
    start[:, 1] = STACKED[1] * (2.0 * np.arange(NUM_STACKED) + 1.0)
    spec = scene(
        [
            box(f"box {i}", STACKED, state, density=DENSITY, **surface)
            for i, state in enumerate(start)
        ]
        + [box("floor", (5.0, 0.5), [0, -0.5, 0, 0, 0, 0], static=True, **surface)],
        gravity=(0.0, -GRAVITY),
    )

    def judge(states):
        moved = np.abs(states[:, :NUM_STACKED] - start)
        depth = deepest_overlap(spec, states[..., :3])
        speed = np.abs(states[-60:, :NUM_STACKED, 3:5]).max()
        return [
            Figure("sideways", 1e3 * float(moved[..., 0].max()), "mm"),
            Figure("up or down", 1e3 * float(moved[..., 1].max()), "mm"),
            Figure("tilt", 1e3 * float(moved[..., 2].max()), "mrad"),
            Figure("deepest overlap", 1e3 * float(depth.max()), "mm"),
            Figure("speed in the last second", 1e3 * float(speed), "mm/s"),
        ]

    return Case("stack of five boxes, 10 s", spec, num_steps, judge)
