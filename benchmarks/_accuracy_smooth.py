"""Scenes without friction or contact: flight, pendulums, a bar on a pin, a chain."""

import itertools

import _repository  # noqa: F401
import numpy as np
from _accuracy_case import (
    DT,
    GRAVITY,
    Case,
    angle_error,
    box,
    pin,
    pin_drift,
    place_error,
    scene,
    velocity_error,
)
from _peers_program import Figure

from tests.reference import chains, closed_forms

DENSITY = 20.0


def smooth_cases() -> list[Case]:
    """Scenes whose motion has no kinks.

    Returns:
        The cases, each with its reference.
    """
    return [
        _free_flight(),
        _chain("pendulum", 1, (0.3, 0.1), 0.0, 300),
        _chain("double pendulum", 2, (0.2, 0.05), 0.0, 120),
        _spinning_bar(),
        _chain("chain of ten", 10, (0.1, 0.03), -np.pi / 4, 60),
    ]


def _free_flight() -> Case:
    start, num_steps = [0.0, 0.0, 0.2, 1.0, 3.0, 2.0], 120
    spec = scene([box("box", (0.2, 0.1), start)], gravity=(0.0, -GRAVITY))

    def judge(states):
        end = closed_forms.free_flight(start, (0.0, -GRAVITY), DT * num_steps)
        heading = angle_error(states[-1, 0, 2], end[2])
        return [
            place_error(states[-1, 0], end),
            velocity_error(states[-1, 0], end),
            Figure("heading", heading, "rad"),
        ]

    return Case("free flight, 2 s", spec, num_steps, judge)


def _spinning_bar() -> Case:
    anchor, spin, num_steps = (0.2, 0.0), 5.0, 600
    times = DT * np.arange(num_steps + 1)
    path = np.array(
        [closed_forms.pinned_spin(anchor, np.zeros(2), 0.0, spin, t) for t in times]
    )
    spec = scene([box("bar", (0.3, 0.03), path[0])], [pin("bar", anchor)])

    def judge(states):
        gain = float(np.mean(states[-60:, 0, 5] ** 2) / spin**2 - 1.0)
        heading = angle_error(states[-1, 0, 2], path[-1, 2])
        return [
            Figure("heading", heading, "rad"),
            Figure("energy gained", 100.0 * gain, "%"),
            pin_drift(spec, states),
        ]

    return Case("spinning bar on a pin, 10 s", spec, num_steps, judge)


def _chain(name: str, num_links: int, half_extents, angle: float, num_steps: int):
    """Links in a straight row, let go at some angle; energy is that over m g l."""
    chain = chains.bars(
        num_links,
        half_length=half_extents[0],
        half_width=half_extents[1],
        density=DENSITY,
    )
    times = DT * np.arange(num_steps + 1)
    rest = np.zeros(num_links)
    path = chains.states(chain, *chains.integrate(chain, rest + angle, rest, times))
    names = [f"link {i}" for i in range(num_links)]
    near, far = (-half_extents[0], 0.0), (half_extents[0], 0.0)
    spec = scene(
        [
            box(label, half_extents, state)
            for label, state in zip(names, path[0], strict=True)
        ],
        [pin(names[0], near)]
        + [pin(a, far, b, near) for a, b in itertools.pairwise(names)],
        gravity=(0.0, -GRAVITY),
    )
    scale = chain.gravity * (chain.mass @ chain.lever).sum()
    start_energy = chains.energy(chain, path[0])

    def judge(states):
        gain = float(chains.energy(chain, states[-1]) - start_energy) / scale
        heading = angle_error(states[..., 2], path[1:, :, 2])
        return [
            Figure("worst heading", heading, "rad"),
            place_error(states, path[1:]),
            Figure("energy gained", 100.0 * gain, "%"),
            pin_drift(spec, states),
        ]

    in_quick = num_links == 1
    title = f"{name}, {num_steps / 60:g} s"
    return Case(title, spec, num_steps, judge, in_quick=in_quick)
