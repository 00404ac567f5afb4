"""Motions of one body that a line of algebra gives."""

import numpy as np


def free_flight(state, gravity, time: float) -> np.ndarray:
    """Pose and twist `[6]` of a body under its weight alone."""
    pull = np.array([*gravity, 0.0])
    pose, twist = np.asarray(state[:3], float), np.asarray(state[3:], float)
    return np.concatenate(
        [pose + time * twist + 0.5 * time**2 * pull, twist + time * pull]
    )


def pinned_spin(anchor, pin, heading: float, spin: float, time: float) -> np.ndarray:
    """Pose and twist `[6]` of a body that turns freely about a pin at its anchor."""
    angle = heading + spin * time
    cos, sin = np.cos(angle), np.sin(angle)
    arm = -np.array([[cos, -sin], [sin, cos]]) @ np.asarray(anchor, float)
    return np.array([*(pin + arm), angle, -spin * arm[1], spin * arm[0], spin])


def dry_slide(speed: float, friction: float, gravity: float, time: float):
    """Distance and speed of a body that dry friction on a level floor brakes."""
    moving = min(time, speed / (friction * gravity))
    return (
        speed * moving - 0.5 * friction * gravity * moving**2,
        speed - friction * gravity * moving,
    )


def slope_slide(slope: float, friction: float, gravity: float, time: float):
    """Distance and speed of a body that is let go on a slope; zero if it sticks."""
    pull = gravity * max(0.0, np.sin(slope) - friction * np.cos(slope))
    return 0.5 * pull * time**2, pull * time


def wheel_decay(speed, viscous, mass: float, time: float):
    """Distances and speeds along and across a viscous wheel under a centre of mass."""
    rate = np.asarray(viscous, float) / mass
    left = np.exp(-rate * time)
    return np.asarray(speed) * (1.0 - left) / rate, np.asarray(speed) * left
