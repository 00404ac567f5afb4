r"""Two discs that collide once, in closed form, and what readings of them tell.

Before and after the instant t* at which their distance is the sum of their radii both
fly straight. In between they exchange an impulse along the normal n, by momentum and
Newton's restitution, and one along the tangent, by Coulomb's law with sticking where it
can (Routh 1905, Dynamics of a system of rigid bodies, part 1, chapter 5):

$$j_n = -(1 + e)\,\frac{n \cdot (v_2 - v_1)}{1/m_1 + 1/m_2}, \qquad
  j_t = \mathrm{clip}\Big(-\frac{v_t}{3 (1/m_1 + 1/m_2)}, \pm \mu j_n\Big),$$

with the factor of three that of solid discs. Nothing here is computed by the engine.

The posterior is on a grid of logarithm of the mass ratio, restitution and friction; at
each point the twelve numbers of the start are integrated out by Laplace's method, which
is all but exact where there are many more readings than that.
"""

from typing import NamedTuple

import numpy as np

DT = 0.02
DENSITY_SPREAD, FRICTION, RESTITUTION = 1.5, (0.3, 0.8), (0.0, 1.5)
"""Default prior: sd of log-density; friction log-normal, restitution logit-normal."""


class Collision(NamedTuple):
    """A collision and noisy readings of it."""

    radius: np.ndarray
    """`[2]` [m]."""
    mass: np.ndarray
    """`[2]` [kg]."""
    restitution: float
    friction: float
    time: np.ndarray
    """Of the readings `[reading]` [s]."""
    pose: np.ndarray
    """Noisy, `[reading, 2, 3]`."""
    noise: np.ndarray
    """Sd of x, y and angle, `[3]`."""


def flight(start, log_ratio, restitution, friction, radius, time) -> np.ndarray:
    """Poses of both discs, for many hypotheses at once.

    Args:
        start: x, y, angle and their rates at time zero, `[point, 2, 6]`.
        log_ratio: logarithm of the first mass over the second, `[point]`.
        restitution: `[point]`.
        friction: `[point]`.
        radius: `[2]`.
        time: `[reading]`.

    Returns:
        `[point, reading, 2, 3]`.
    """
    offset = start[:, 1, :2] - start[:, 0, :2]
    speed = start[:, 1, 3:5] - start[:, 0, 3:5]
    a, b = np.sum(speed**2, axis=-1), np.sum(offset * speed, axis=-1)
    square = b**2 - a * (np.sum(offset**2, axis=-1) - np.sum(radius) ** 2)
    meets = (square > 0) & (b < 0)
    root = np.sqrt(np.where(meets, square, 0.0))
    touch = np.where(meets, (-b - root) / np.maximum(a, 1e-12), np.inf)
    finite = np.where(meets, touch, 0.0)
    normal = (offset + speed * finite[:, None]) / np.sum(radius)
    tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=-1)
    # Only the ratio of the masses matters; the second one is taken as one.
    ease = np.stack([np.exp(-log_ratio), np.ones_like(log_ratio)], axis=-1)
    total = ease.sum(axis=-1)
    press = -(1.0 + restitution) * np.sum(speed * normal, axis=-1) / total
    slide = np.sum(speed * tangent, axis=-1)
    slide = slide - start[:, 0, 5] * radius[0] - start[:, 1, 5] * radius[1]
    rub = np.clip(-slide / (3.0 * total), -friction * press, friction * press)
    push = press[:, None] * normal + rub[:, None] * tangent
    # A solid disc's inertia is half of m r²; both are turned the same way.
    spin = -2.0 * rub[:, None] * ease / radius[None]
    sign = np.array([-1.0, 1.0])
    change = np.concatenate(
        [sign[None, :, None] * push[:, None] * ease[..., None], spin[..., None]], -1
    )
    after = np.maximum(time[None] - touch[:, None], 0.0)
    after = np.where(meets[:, None], after, 0.0)
    straight = start[:, None, :, :3] + time[None, :, None, None] * start[:, None, :, 3:]
    return straight + after[:, :, None, None] * change[:, None]


def random_collision(
    rng: np.random.Generator, num_readings: int = 41, sd: float = 1e-3
) -> Collision:
    """Two discs of random size and mass that meet off their centres.

    Args:
        rng: source of randomness.
        num_readings: every 20 ms.
        sd: of readings of places [m]; of angles it is five times that [rad].

    Returns:
        Truth and readings; they meet about half-way.
    """
    radius = rng.uniform(0.06, 0.12, 2)
    mass = np.exp(0.7 * rng.standard_normal(2))
    restitution, friction = rng.uniform(0.1, 0.95), rng.uniform(0.05, 0.5)
    time = DT * np.arange(num_readings)
    middle = time[-1] * rng.uniform(0.4, 0.6)
    # Where and how they are when they meet, and from there back.
    angle, turn = rng.uniform(-np.pi, np.pi, 2)
    normal = np.array([np.cos(angle), np.sin(angle)])
    tangent = np.array([-normal[1], normal[0]])
    closing = -rng.uniform(0.6, 1.6) * normal + rng.uniform(-0.8, 0.8) * tangent
    drift = rng.uniform(0.0, 0.3) * np.array([np.cos(turn), np.sin(turn)])
    share = rng.uniform(0.2, 0.8)
    velocity = np.stack([drift - share * closing, drift + (1.0 - share) * closing])
    spin = rng.uniform(-2.0, 2.0, 2)
    place = np.stack([np.zeros(2), radius.sum() * normal]) - middle * velocity
    start = np.concatenate(
        [place, rng.uniform(-1, 1, (2, 1)), velocity, spin[:, None]], axis=-1
    )
    log_ratio = np.log(mass[0] / mass[1])
    pose = flight(
        start[None],
        *(np.array([x]) for x in (log_ratio, restitution, friction)),
        radius,
        time,
    )[0]
    noise = np.array([sd, sd, 5.0 * sd])
    pose = pose + noise * rng.standard_normal(pose.shape)
    return Collision(radius, mass, restitution, friction, time, pose, noise)


class GridPosterior(NamedTuple):
    """Posterior of logarithm of the mass ratio, restitution and friction."""

    axes: tuple[np.ndarray, np.ndarray, np.ndarray]
    weight: np.ndarray
    """`[ratio, restitution, friction]`; sums to one."""

    def quantiles(self, axis: int, levels) -> np.ndarray:
        """Of one number."""
        weight = self.weight.sum(axis=tuple(i for i in range(3) if i != axis))
        middle = np.cumsum(weight) - 0.5 * weight
        return np.interp(levels, middle, self.axes[axis])

    def moments(self, axis: int) -> tuple[float, float]:
        """Mean and sd of one number."""
        weight = self.weight.sum(axis=tuple(i for i in range(3) if i != axis))
        mean = weight @ self.axes[axis]
        return float(mean), float(np.sqrt(weight @ (self.axes[axis] - mean) ** 2))


_LIMITS = np.array([[-6.0, 0.005, -5.5], [6.0, 0.9995, 1.5]])
_COARSE, _FINE, _MOST_PASSES = (9, 9, 7), (15, 15, 11), 10
_WINDOW = 4.5


def grid_posterior(collision: Collision) -> GridPosterior:
    """Posterior under the default prior, with known noise and flat priors of the start.

    Coarse grids close in on the bulk until a fine one resolves it.
    """
    low, high = _LIMITS
    for number in range(_MOST_PASSES):
        found = _on_grid(collision, low, high, _COARSE)
        moments = np.array([found.moments(i) for i in range(3)])
        step = (high - low) / (np.array(_COARSE) - 1)
        reach = np.maximum(_WINDOW * moments[:, 1], step)
        low = np.maximum(moments[:, 0] - reach, _LIMITS[0])
        high = np.minimum(moments[:, 0] + reach, _LIMITS[1])
        if number > 0 and np.all(step < 1.3 * moments[:, 1]):
            break
    return _on_grid(collision, low, high, _FINE)


def _on_grid(collision: Collision, low, high, shape) -> GridPosterior:
    axes = [np.linspace(a, b, n) for a, b, n in zip(low, high, shape, strict=True)]
    mesh = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    log_ratio, restitution, log_friction = mesh.T
    value = _log_marginal(collision, log_ratio, restitution, np.exp(log_friction))
    value += log_prior(collision, log_ratio, restitution, log_friction)
    weight = np.exp(value - value.max())
    weight = (weight / weight.sum()).reshape(shape)
    return GridPosterior((axes[0], axes[1], axes[2]), weight)


def log_prior(collision: Collision, log_ratio, restitution, log_friction):
    """Log-density of the default prior over what the grid is of, `[point]`."""
    area = np.pi * collision.radius**2
    spread = DENSITY_SPREAD * np.sqrt(2.0)
    ratio = (log_ratio - np.log(area[0] / area[1])) / spread
    rub = (log_friction - np.log(FRICTION[0])) / FRICTION[1]
    logit = np.log(restitution) - np.log1p(-restitution)
    bounce = (logit - RESTITUTION[0]) / RESTITUTION[1]
    volume = np.log(restitution) + np.log1p(-restitution)
    return -0.5 * (ratio**2 + rub**2 + bounce**2) - volume


def _log_marginal(collision: Collision, log_ratio, restitution, friction) -> np.ndarray:
    """Log-likelihood of many points with the start integrated out."""
    scale = np.array([1.0, 1.0, 5.0, 10.0, 10.0, 50.0]) * collision.noise[0]
    read = collision.pose / collision.noise

    def residual(start, rows):
        numbers = (x[rows] for x in (log_ratio, restitution, friction))
        found = flight(start, *numbers, collision.radius, collision.time)
        return (found / collision.noise - read).reshape(len(start), -1)

    start = np.repeat(_first_guess(collision)[None], len(log_ratio), axis=0)
    rows = np.arange(len(log_ratio))
    best = residual(start, rows)
    value = 0.5 * np.sum(best**2, axis=-1)
    matrix = np.zeros((len(start), 12, 12))
    damping = np.full(len(start), 1e-3)
    for _ in range(12):
        columns = []
        for k in range(12):
            moved = start.reshape(-1, 12).copy()
            moved[:, k] += 0.1 * np.tile(scale, 2)[k]
            rise = residual(moved.reshape(-1, 2, 6), rows) - best
            columns.append(rise / 0.1)
        jacobian = np.stack(columns, axis=1)
        matrix = jacobian @ np.swapaxes(jacobian, 1, 2)
        slope = np.einsum("pkr,pr->pk", jacobian, best)
        size = np.trace(matrix, axis1=1, axis2=2) / 12.0
        ridge = (damping * size)[:, None, None] * np.eye(12)
        step = -np.linalg.solve(matrix + ridge, slope[..., None])[..., 0]
        trial = start + step.reshape(-1, 2, 6) * scale
        found = residual(trial, rows)
        better = 0.5 * np.sum(found**2, axis=-1)
        is_better = better < value
        start = np.where(is_better[:, None, None], trial, start)
        best = np.where(is_better[:, None], found, best)
        gain = np.max(np.where(is_better, value - better, 0.0))
        value = np.where(is_better, better, value)
        damping = np.clip(np.where(is_better, 0.1 * damping, 10.0 * damping), 1e-9, 1e3)
        if gain < 1e-3 and np.all(is_better | (damping > 1e-6)):
            break
    return -value - 0.5 * np.linalg.slogdet(matrix)[1]


def _first_guess(collision: Collision) -> np.ndarray:
    """Straight lines through the readings of the first third, `[2, 6]`."""
    num = len(collision.time) // 3
    design = np.stack([np.ones(num), collision.time[:num]], axis=-1)
    flat = collision.pose[:num].reshape(num, 6)
    line = np.linalg.lstsq(design, flat, rcond=None)[0].reshape(2, 2, 3)
    return np.concatenate([line[0], line[1]], axis=-1)
