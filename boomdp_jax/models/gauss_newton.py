r"""Gauss-Newton with damping, from many starts at once.

For residuals r with derivatives J a step solves $(J^T J + \mu D) \delta = -J^T r$, D
the diagonal of $J^T J$ (Levenberg 1944, Marquardt 1963); three dampings μ are tried at
a time and the best point is taken if it is better. Ten to twenty steps settle what a
first-order method needs thousands for; where residuals jump it finds nothing, and other
starts have to.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import FloatScalar, IntScalar
from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.models.table import check_at_least

_DAMPING_FACTORS = (0.1, 1.0, 10.0)
_FIRST_DAMPING, _DAMPING_LIMITS = 1e-2, (1e-8, 1e8)


@full_precision
def gauss_newton(
    residual_fn: Callable[[Float[Array, " dim"]], Float[Array, " residual"]],
    start: Float[Array, " dim"],
    *,
    num_steps: IntScalar | int = 15,
) -> tuple[Float[Array, " dim"], FloatScalar]:
    """Make a sum of squares small, from one start; `vmap` for many.

    The residuals are compiled twice, with derivatives and without.

    Args:
        residual_fn: what is squared; not finite where a point is impossible.
        start: where to begin.
        num_steps: how often to linearise, at least once; may be known only at run time.

    Returns:
        The last point, never worse than the start, and its sum of squares.

    Raises:
        ValueError: no step.
    """
    if isinstance(num_steps, int):
        check_at_least("num_steps", num_steps, 1)

    def twice(point: Array) -> tuple[Array, Array]:
        residual = residual_fn(point)
        return residual, residual

    def move(_: IntScalar, carry: tuple) -> tuple:
        point, _, damping = carry
        jacobian, residual = jax.jacfwd(twice, has_aux=True)(point)
        loss = sum_of_squares(residual)
        # One direction that derivatives say nothing of must not spoil the others.
        jacobian = jnp.where(jnp.isfinite(jacobian), jacobian, 0.0)
        residual = jnp.where(jnp.isfinite(residual), residual, 0.0)
        gradient, hessian = jacobian.T @ residual, jacobian.T @ jacobian
        scale = jnp.diagonal(hessian)
        scale = jnp.maximum(scale, 1e-6 * jnp.max(scale) + 1e-12)
        tries = damping * jnp.asarray(_DAMPING_FACTORS, point.dtype)

        def attempt(mu: FloatScalar) -> tuple[Array, Array]:
            matrix = hessian + jnp.diag(mu * scale)
            there = point - jnp.linalg.solve(matrix, gradient)
            return there, sum_of_squares(residual_fn(there))

        points, losses = jax.vmap(attempt)(tries)
        best = jnp.argmin(losses)
        is_better = losses[best] < loss
        damping = jnp.where(is_better, tries[best], 100.0 * damping)
        return (
            jnp.where(is_better, points[best], point),
            jnp.where(is_better, losses[best], loss),
            jnp.clip(damping, *_DAMPING_LIMITS),
        )

    first = (
        start,
        jnp.asarray(jnp.inf, start.dtype),
        jnp.asarray(_FIRST_DAMPING, start.dtype),
    )
    point, loss, _ = jax.lax.fori_loop(0, num_steps, move, first)
    return point, loss


def sum_of_squares(residual: Float[Array, " residual"]) -> FloatScalar:
    """Infinite where a residual is not finite."""
    loss = jnp.sum(residual**2)
    return jnp.where(jnp.isfinite(loss), loss, jnp.inf)
