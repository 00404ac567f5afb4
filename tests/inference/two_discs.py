"""Two discs that collide once: where they go and what readings say, in closed form."""

import numpy as np
from scipy.optimize import least_squares

from boomdp_jax.core.history import History, make_history
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict

DT = 0.02
RADIUS = np.array([0.1, 0.08])
NOISE = np.array([1e-3, 1e-3, 5e-3])


def discs_spec(*, density=None, contact=None, **more) -> SceneSpec:
    """The scene; what is None is to be inferred."""
    density = (None, None) if density is None else density
    contact = {"friction": None, "restitution": None} if contact is None else contact
    bodies = [
        {
            "name": name,
            "shape": {"type": "circle", "radius": radius},
            "contact": contact,
            "density": own,
        }
        for name, radius, own in zip("ab", RADIUS, density, strict=True)
    ]
    return scene_spec_from_dict(
        {"schema": "planar-scene-1", "dt": DT, "bodies": bodies, **more}, source="test"
    )


def state_at(start, numbers, time: float) -> np.ndarray:
    """State of both discs, `[2, 6]`.

    Momentum along the line of centres with Newton's restitution, Coulomb's law across
    it, sticking where friction can (Routh 1905, Dynamics of a system of rigid bodies).

    Args:
        start: states at time zero, `[2, 6]`.
        numbers: both masses [kg], restitution, friction.
        time: may lie before or after they meet [s].
    """
    (first, second), (m, n, restitution, friction) = np.array(start), numbers
    offset, speed = second[:2] - first[:2], second[3:5] - first[3:5]
    a, b = speed @ speed, offset @ speed
    c = offset @ offset - RADIUS.sum() ** 2
    inside = b * b - a * c
    touch = (-b - np.sqrt(inside)) / a if inside > 0 and b < 0 else np.inf
    if time <= touch:
        return np.stack([_flown(first, time), _flown(second, time)])
    first, second = _flown(first, touch), _flown(second, touch)
    normal = (second[:2] - first[:2]) / RADIUS.sum()
    tangent = np.array([-normal[1], normal[0]])
    slide = speed @ tangent - first[5] * RADIUS[0] - second[5] * RADIUS[1]
    press = -(1.0 + restitution) * (speed @ normal) / (1.0 / m + 1.0 / n)
    stick = -slide / (3.0 * (1.0 / m + 1.0 / n))
    rub = np.clip(stick, -friction * press, friction * press)
    push = press * normal + rub * tangent
    first[3:5] -= push / m
    second[3:5] += push / n
    first[5] -= rub / (0.5 * m * RADIUS[0])
    second[5] -= rub / (0.5 * n * RADIUS[1])
    return np.stack([_flown(first, time - touch), _flown(second, time - touch)])


def _flown(state: np.ndarray, time: float) -> np.ndarray:
    return np.concatenate([state[:3] + time * state[3:], state[3:]])


def approaching(
    rng: np.random.Generator, touch: float, *, closing=(0.5, 1.5)
) -> np.ndarray:
    """States of two discs that meet, off their centres, after a given time [s]."""
    angle = rng.uniform(-np.pi, np.pi)
    normal = np.array([np.cos(angle), np.sin(angle)])
    tangent = np.array([-normal[1], normal[0]])
    relative = -rng.uniform(*closing) * normal + rng.uniform(-0.7, 0.7) * tangent
    velocity = rng.uniform(-0.2, 0.2, 2) + np.outer([-0.4, 0.6], relative)
    place = np.outer([0.0, RADIUS.sum()], normal) - touch * velocity
    angles, spins = rng.uniform(-2.0, 2.0, (2, 2, 1))
    return np.concatenate([place, angles, velocity, spins], axis=-1)


def record(rng, start, numbers, num_readings: int) -> History:
    """Noisy poses without rates, and no wrench."""
    times = DT * np.arange(num_readings)
    true = np.stack([state_at(start, numbers, time)[:, :3] for time in times])
    state = np.full((num_readings, 2, 6), np.nan)
    state[..., :3] = true + NOISE * rng.standard_normal(true.shape)
    still = np.zeros((num_readings - 1, 2, 3))
    return make_history(state[:-1], still, state[1:], DT)


def log_marginal(history: History, start, numbers) -> float:
    """Log-likelihood up to a constant, start integrated out by Laplace's method.

    Args:
        history: as `record` makes it.
        start: where to begin the search for the most probable start.
        numbers: both masses, restitution, friction.
    """
    poses = np.concatenate([history.state[:1], history.next_state])[..., :3]
    scale = np.tile([1e-3, 1e-3, 5e-3, 5e-3, 5e-3, 2e-2], 2)
    start = np.asarray(start).reshape(-1)

    def residual(x):
        now = (start + scale * x).reshape(2, 6)
        found = [state_at(now, numbers, DT * t)[:, :3] for t in range(len(poses))]
        return ((np.stack(found) - poses) / NOISE).reshape(-1)

    fit = least_squares(residual, np.zeros(12), diff_step=1e-2, xtol=1e-10)
    matrix = fit.jac.T @ fit.jac
    return float(-fit.cost - 0.5 * np.linalg.slogdet(matrix)[1])
