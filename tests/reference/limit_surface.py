r"""Quasi-static sliding of a body on dry feet, towed by one of its points.

A foot at $r_i$ with load $N_i$ resists with $-μ N_i\, v_i/|v_i|$. A tow point can give
no moment about itself, which fixes the turn rate: the feet's moments about the tow
point balance. The ellipsoid $(f/f_{max})^2 + (τ/τ_{max})^2 = 1$ is the usual stand-in
for that law (Howe and Cutkosky 1996, Practical force-motion models for sliding
manipulation); it is here to see how far it is from the feet.
"""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq


def foot_wrench(feet, limit, twist) -> np.ndarray:
    """Friction of dry feet on a sliding body, body frame and body origin.

    Args:
        feet: where they stand, `[foot, 2]` [m].
        limit: friction coefficient times load of each foot [N].
        twist: of the body's origin, body frame [m/s, m/s, rad/s].

    Returns:
        Force and torque `[3]`.
    """
    feet = np.asarray(feet, float)
    turned = np.column_stack([-feet[:, 1], feet[:, 0]])
    velocity = np.asarray(twist[:2], float) + twist[2] * turned
    speed = np.linalg.norm(velocity, axis=1, keepdims=True)
    force = -np.asarray(limit)[:, None] * velocity / np.maximum(speed, 1e-300)
    torque = feet[:, 0] * force[:, 1] - feet[:, 1] * force[:, 0]
    return np.array([*force.sum(axis=0), torque.sum()])


def ellipsoid_wrench(feet, limit, twist) -> np.ndarray:
    """The same by the ellipsoid through the pure slide and the pure spin."""
    feet, limit = np.asarray(feet, float), np.asarray(limit, float)
    most = limit.sum(), limit @ np.hypot(*feet.T)
    scaled = np.array([most[0] ** 2, most[0] ** 2, most[1] ** 2]) * np.asarray(twist)
    size = np.sqrt(np.asarray(twist) @ scaled)
    return -scaled / max(size, 1e-300)


def towed_spin(feet, limit, anchor, velocity, *, law=foot_wrench) -> float:
    """Turn rate of a body whose anchor is towed.

    Args:
        feet: where it stands, body frame `[foot, 2]` [m].
        limit: friction coefficient times load of each foot [N].
        anchor: tow point, body frame [m].
        velocity: of the tow point, body frame [m/s].
        law: wrench of friction for a twist.

    Returns:
        The turn rate [rad/s].
    """
    anchor, velocity = np.asarray(anchor, float), np.asarray(velocity, float)

    def moment(spin):
        twist = np.array([*(velocity - spin * np.array([-anchor[1], anchor[0]])), spin])
        wrench = law(feet, limit, twist)
        return wrench[2] - (anchor[0] * wrench[1] - anchor[1] * wrench[0])

    bound = 10.0 * np.linalg.norm(velocity) / np.linalg.norm(anchor)
    return float(brentq(moment, -bound, bound, xtol=1e-14, rtol=1e-12))


def towed_heading(
    feet, limit, anchor, velocity, heading: float, times, *, law=foot_wrench
) -> np.ndarray:
    """Headings of a body whose anchor is towed at a constant world velocity [rad]."""

    def rate(_, y):
        cos, sin = np.cos(y[0]), np.sin(y[0])
        local = np.array([[cos, sin], [-sin, cos]]) @ np.asarray(velocity, float)
        return [towed_spin(feet, limit, anchor, local, law=law)]

    solution = solve_ivp(
        rate, (0.0, float(times[-1])), [heading], t_eval=times, rtol=1e-8, atol=1e-10
    )
    assert solution.success, solution.message
    return solution.y[0]
