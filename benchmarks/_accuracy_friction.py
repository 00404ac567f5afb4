"""Scenes of friction: on a floor seen from above, on a slope, under a wheel."""

import _repository  # noqa: F401
import numpy as np
from _accuracy_case import (
    DT,
    GRAVITY,
    Case,
    angle_error,
    box,
    pin,
    place_error,
    scene,
    velocity_error,
)
from _overlap import deepest_overlap
from _peers_program import Figure

from tests.reference import closed_forms, limit_surface, planar_dynamics

FRICTION, DENSITY = 0.3, 20.0
SIZE = (0.2, 0.1)
FEET = [[x / 3**0.5, y / 3**0.5] for x, y in ((0.2, 0.1), (-0.2, 0.1))]
FEET += [[-x, -y] for x, y in FEET]
SLOPE = 0.35
"""Its angle [rad]; friction of 0.365 just holds a box there."""
TOW_SPEED, TOW_ANCHOR, TOW_HEADING = 0.02, (0.2, 0.0), 1.0
"""Slow enough for inertia to be two ten-thousandths of friction."""
TUG_DENSITY = 1e8
"""Of a tug of a thousand tonnes, which friction neither slows nor turns aside."""
KNEE = 1e-4
"""Speed below which the towed box's friction is viscous [m/s]."""


def friction_cases() -> list[Case]:
    """Scenes that friction decides.

    Returns:
        The cases, each with its reference.
    """
    return [
        _sliding("sliding box, 1.5 s", [0, 0, 0, 3.0, 0, 0], 90),
        _sliding("sliding and turning box, 0.5 s", [0, 0, 0, 2.0, 0, 6.0], 30),
        _on_slope("box sticks on a slope, 2 s", 0.5, 120),
        _on_slope("box slips on a slope, 1 s", 0.2, 60),
        _wheel(),
        _towed(),
    ]


def _sliding(name: str, start: list[float], num_steps: int) -> Case:
    ground = {"type": "ground", "a": "box", "dry": FRICTION}
    spec = scene([box("box", SIZE, start, feet=FEET)], [ground])
    time = DT * num_steps
    expected = np.zeros(6)
    if start[5]:
        # The limit of a steep law: nothing comes to rest before the end.
        mass = 4.0 * SIZE[0] * SIZE[1] * DENSITY
        steep = FRICTION * mass * GRAVITY / 1e-3
        world = planar_dynamics.World(
            [SIZE],
            [DENSITY],
            grounds=[planar_dynamics.Ground(0, FRICTION, steep)],
        )
        pose, twist = planar_dynamics.integrate(
            world,
            np.array([start[:3]]),
            np.array([start[3:]]),
            np.array([time]),
            rtol=1e-8,
        )
        expected = np.concatenate([pose[-1, 0], twist[-1, 0]])
    else:
        expected[0], expected[3] = closed_forms.dry_slide(
            start[3], FRICTION, GRAVITY, time
        )

    def judge(states):
        end = states[-1, 0]
        heading = angle_error(end[2], expected[2])
        return [
            place_error(end, expected),
            velocity_error(end, expected),
            Figure("heading", heading, "rad"),
        ]

    return Case(name, spec, num_steps, judge, in_quick=bool(start[5]))


def _on_slope(name: str, friction: float, num_steps: int) -> Case:
    """The floor is level and gravity is not."""
    contact = {"friction": friction, "restitution": 0.0}
    start = [0.0, SIZE[1], 0.0, 0.0, 0.0, 0.0]
    floor = [0.0, -0.5, 0.0, 0.0, 0.0, 0.0]
    spec = scene(
        [
            box("box", SIZE, start, contact=contact),
            box("floor", (20.0, 0.5), floor, contact=contact, static=True),
        ],
        gravity=(GRAVITY * np.sin(SLOPE), -GRAVITY * np.cos(SLOPE)),
    )
    distance, speed = closed_forms.slope_slide(SLOPE, friction, GRAVITY, DT * num_steps)

    def judge(states):
        depth = float(deepest_overlap(spec, states[..., :3]).max())
        end = states[-1, 0]
        return [
            Figure("slid distance", 1e3 * abs(float(end[0] - distance)), "mm"),
            Figure("speed", 1e3 * abs(float(end[3] - speed)), "mm/s"),
            Figure("deepest overlap", 1e3 * depth, "mm"),
        ]

    return Case(name, spec, num_steps, judge, in_quick=distance > 0.0)


def _wheel() -> Case:
    heading, speed, viscous, num_steps = 0.3, np.array([1.0, 0.5]), [1.0, 30.0], 60
    frame = planar_dynamics.rotation(heading)
    wheel = {"type": "wheel", "a": "cart", "pose": [0, 0, heading], "viscous": viscous}
    spec = scene([box("cart", SIZE, [0, 0, 0, *(frame @ speed), 0])], [wheel])
    mass = 4.0 * SIZE[0] * SIZE[1] * DENSITY
    place, left = closed_forms.wheel_decay(speed, viscous, mass, DT * num_steps)
    expected = np.array([*(frame @ place), 0.0, *(frame @ left), 0.0])

    def judge(states):
        end = states[-1, 0]
        return [place_error(end, expected), velocity_error(end, expected)]

    return Case("cart on a viscous wheel, 1 s", spec, num_steps, judge)


def _towed() -> Case:
    """Quasi-static pushing: a heavy tug draws a box round by one of its points."""
    num_steps = 600
    mass = 4.0 * SIZE[0] * SIZE[1] * DENSITY
    limit = np.full(4, 0.25 * FRICTION * mass * GRAVITY)
    velocity = np.array([TOW_SPEED, 0.0])
    frame = planar_dynamics.rotation(TOW_HEADING)
    arm = frame @ TOW_ANCHOR
    spin = limit_surface.towed_spin(FEET, limit, TOW_ANCHOR, frame.T @ velocity)
    drift = velocity + spin * np.array([arm[1], -arm[0]])
    ground = {
        "type": "ground",
        "a": "box",
        "dry": FRICTION,
        "viscous": float(limit.sum() / KNEE),
    }
    spec = scene(
        [
            box("box", SIZE, [*-arm, TOW_HEADING, *drift, spin], feet=FEET),
            box("tug", (0.05, 0.05), [0, 0, 0, *velocity, 0], density=TUG_DENSITY),
        ],
        [ground, pin("box", TOW_ANCHOR, "tug")],
    )
    times = DT * np.arange(1, num_steps + 1)
    by_law = {
        law: limit_surface.towed_heading(
            FEET, limit, TOW_ANCHOR, velocity, TOW_HEADING, times, law=law
        )
        for law in (limit_surface.foot_wrench, limit_surface.ellipsoid_wrench)
    }
    expected = by_law[limit_surface.foot_wrench]
    ellipsoid = np.zeros((num_steps, 2, 6))
    ellipsoid[:, 0, 2] = by_law[limit_surface.ellipsoid_wrench]

    def judge(states):
        heading = states[:, 0, 2]
        rate = (heading[59] - TOW_HEADING) / (expected[59] - TOW_HEADING) - 1.0
        return [
            Figure("worst heading", angle_error(heading, expected), "rad"),
            Figure("turn rate, first second", 100.0 * abs(float(rate)), "%"),
        ]

    stand_ins = {"ellipsoid limit surface": ellipsoid}
    return Case("box in tow, 10 s", spec, num_steps, judge, stand_ins, in_quick=False)
