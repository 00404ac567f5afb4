r"""Where a rod would have to be: least squares of its length over all readings.

A rod keeps $|x_a + R_a r_a - x_b - R_b r_b|$ at its length, and the rate of that at
zero. Unlike a pin's condition that is not linear in the anchors and has many optima, so
it is solved from many places by Levenberg and Marquardt's method: with no physics in
it, that costs next to nothing.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.inference.readings.single_steps import Readings
from boomdp_jax.physics.params import WORLD

# Places to start from, the same ones always, and iterations from each.
_NUM_STARTS, _NUM_ITERATIONS = 64, 30
_LEAST_DAMPING, _MOST_DAMPING = 1e-6, 1e6


@full_precision
def rod_guess(
    data: Readings,
    body_a: int,
    body_b: int,
    unit: Float[Array, "2"],
    origin: Float[Array, " 2"],
    noise: tuple[float, float],
) -> tuple[Float[Array, " 2"], Float[Array, " 2"], Float[Array, ""]]:
    """Anchors between which the distance changes least, and that distance.

    Args:
        data: readings of a block.
        body_a: one body.
        body_b: the other, or `WORLD`, whose anchor is then a fixed world point.
        unit: prior scale of either anchor [m], a weak ridge.
        origin: about which the second anchor lies [m], in the frame of its body.
        noise: distance [m] and speed [m/s] that weigh the same.

    Returns:
        Both anchors [m], and the length [m].
    """
    mask = data.mask[:, body_a, 0]
    total = jnp.maximum(jnp.sum(mask), 1.0)

    def anchors(u):
        return unit[0] * u[:2], origin + unit[1] * u[2:]

    def length(u):
        gap, rate = _gap(data, body_a, body_b, *anchors(u))
        far = jnp.sqrt(jnp.sum(gap**2, axis=1) + 1e-12)
        return far, jnp.sum(gap * rate, axis=1) / far

    def residuals(u):
        far, rate = length(u)
        off = far - jnp.sum(mask * far) / total
        return jnp.concatenate([mask * off / noise[0], mask * rate / noise[1], u])

    def climb(u):
        def iterate(_, carry):
            u, cost, damping = carry
            here, slope = residuals(u), jax.jacfwd(residuals)(u)
            normal = slope.T @ slope
            normal = normal + damping * jnp.diag(jnp.diagonal(normal))
            trial = u - jnp.linalg.solve(normal, slope.T @ here)
            found = jnp.sum(residuals(trial) ** 2)
            is_better = found < cost
            factor = jnp.where(is_better, 0.3, 4.0)
            damping = jnp.clip(damping * factor, _LEAST_DAMPING, _MOST_DAMPING)
            u = jnp.where(is_better, trial, u)
            return u, jnp.where(is_better, found, cost), damping

        start = u, jnp.sum(residuals(u) ** 2), jnp.ones(())
        return jax.lax.fori_loop(0, _NUM_ITERATIONS, iterate, start)[:2]

    starts = np.random.default_rng(0).standard_normal((_NUM_STARTS, 4))
    found, cost = jax.vmap(climb)(jnp.asarray(starts, data.state.dtype))
    best = found[jnp.argmin(jnp.where(jnp.isfinite(cost), cost, jnp.inf))]
    far, _ = length(best)
    return *anchors(best), jnp.sum(mask * far) / total


def _gap(data: Readings, body_a: int, body_b: int, anchor_a, anchor_b):
    """From the second anchor to the first in every row, and the rate of that."""
    place, speed = _moving(data, body_a, anchor_a)
    if body_b == WORLD:
        return place - anchor_b[None], speed
    other, other_speed = _moving(data, body_b, anchor_b)
    return place - other, speed - other_speed


def _moving(data: Readings, body: int, anchor) -> tuple:
    """Where a point of a body is in every row, and how fast."""
    angle, spin = data.state[:, body, 2], data.state[:, body, 5, None]
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    x, y = cos * anchor[0] - sin * anchor[1], sin * anchor[0] + cos * anchor[1]
    arm = jnp.stack([x, y], axis=1)
    turned = jnp.stack([-y, x], axis=1)
    return data.state[:, body, :2] + arm, data.state[:, body, 3:5] + spin * turned
