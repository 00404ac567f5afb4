r"""Frictionless impacts of two bodies, and rows of balls, in closed form.

With the unit normal $n$ from $a$ to $b$, levers $r \times n$ and the reduced mass
$1/k = 1/m_a + 1/m_b + (r_a \times n)^2/I_a + (r_b \times n)^2/I_b$, the impulse is
$j = -(1 + e)\,k\,v_n$, where $v_n < 0$ is the speed at which the gap opens.
"""

import numpy as np


def impact(
    mass, inertia, twist: np.ndarray, arm: np.ndarray, normal, restitution: float
) -> np.ndarray:
    """Twists of two bodies right after they hit each other, `[2, 3]`.

    Args:
        mass: of both bodies [kg].
        inertia: of both bodies [kg m²].
        twist: of both bodies before, `[2, 3]`.
        arm: from each centre of mass to the point of contact, `[2, 2]` [m].
        normal: unit vector from the first body to the second.
        restitution: speed of separation over speed of approach.

    Returns:
        The twists after; unchanged if the bodies separate.
    """
    mass, inertia = np.asarray(mass, float), np.asarray(inertia, float)
    twist, arm = np.asarray(twist, float), np.asarray(arm, float)
    normal = np.asarray(normal, float)
    lever = arm[:, 0] * normal[1] - arm[:, 1] * normal[0]
    along = twist[:, :2] @ normal + lever * twist[:, 2]
    opening = along[1] - along[0]
    if opening >= 0.0:
        return twist.copy()
    reduced = 1.0 / np.sum(1.0 / mass + lever**2 / inertia)
    impulse = -(1.0 + restitution) * reduced * opening
    row = np.column_stack([np.tile(normal, (2, 1)), lever])
    inverse = 1.0 / np.column_stack([mass, mass, inertia])
    return twist + np.array([[-impulse], [impulse]]) * inverse * row


def meeting_time(position: np.ndarray, velocity: np.ndarray, reach: float) -> float:
    """When two points come within a distance of each other; infinite if never."""
    gap = np.subtract(position[1], position[0])
    rate = np.subtract(velocity[1], velocity[0])
    a, b, c = rate @ rate, gap @ rate, gap @ gap - reach**2
    discriminant = b**2 - a * c
    if b >= 0.0 or discriminant < 0.0:
        return np.inf
    return float((-b - np.sqrt(discriminant)) / a)


def two_balls(
    radius, density: float, state: np.ndarray, restitution: float, time: float
) -> np.ndarray:
    """Poses and twists of two smooth discs after some time, `[2, 6]`."""
    radius = np.asarray(radius, float)
    mass = np.pi * radius**2 * density
    pose, twist = np.array(state[:, :3], float), np.array(state[:, 3:], float)
    first = min(time, meeting_time(pose[:, :2], twist[:, :2], radius.sum()))
    pose += first * twist
    if first < time:
        normal = (pose[1, :2] - pose[0, :2]) / radius.sum()
        arm = np.array([radius[0] * normal, -radius[1] * normal])
        inertia = 0.5 * mass * radius**2
        twist = impact(mass, inertia, twist, arm, normal, restitution)
        pose += (time - first) * twist
    return np.concatenate([pose, twist], axis=1)


def row_of_balls(
    position, velocity, diameter: float, time: float
) -> tuple[np.ndarray, np.ndarray]:
    """Equal, perfectly elastic balls on a line after some time.

    They swap their velocities at every hit, so the sorted free paths, taken between
    centres less the diameters, are the balls'.

    Returns:
        Positions and velocities, in the order of the row.
    """
    velocity = np.asarray(velocity, float)
    offset = diameter * np.arange(len(velocity))
    free = np.asarray(position, float) - offset + time * velocity
    order = np.argsort(free, kind="stable")
    return free[order] + offset, velocity[order]
