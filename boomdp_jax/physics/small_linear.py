"""Small linear solves: written out in scalars, or along lanes."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

# Rows that are not worth finding out which of them are needed.
_FEW_ROWS = 5


def inverse3(a):
    """Inverse of a 3 x 3 matrix by cofactors.

    Args:
        a: rows of entries, each entry an array of one shape.

    Returns:
        The inverse, in the same form. A singular matrix gives infinities.
    """
    (a00, a01, a02), (a10, a11, a12), (a20, a21, a22) = a
    c00 = a11 * a22 - a12 * a21
    c01 = a12 * a20 - a10 * a22
    c02 = a10 * a21 - a11 * a20
    scale = 1.0 / (a00 * c00 + a01 * c01 + a02 * c02)
    return (
        (c00 * scale, (a02 * a21 - a01 * a22) * scale, (a01 * a12 - a02 * a11) * scale),
        (c01 * scale, (a00 * a22 - a02 * a20) * scale, (a02 * a10 - a00 * a12) * scale),
        (c02 * scale, (a01 * a20 - a00 * a21) * scale, (a00 * a11 - a01 * a10) * scale),
    )


def matvec3(a, x):
    """Product of a 3 x 3 matrix and a vector, both in scalars."""
    return tuple(row[0] * x[0] + row[1] * x[1] + row[2] * x[2] for row in a)


def dot3(x, y):
    """Inner product of two vectors in scalars."""
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


def solve3(a, b):
    """Solve a 3 x 3 system by Cramer's rule.

    Args:
        a: rows of entries, each entry an array of one shape.
        b: right-hand side, three such arrays.

    Returns:
        The solution, three arrays.
    """
    (a00, a01, a02), (a10, a11, a12), (a20, a21, a22) = a
    c00 = a11 * a22 - a12 * a21
    c01 = a12 * a20 - a10 * a22
    c02 = a10 * a21 - a11 * a20
    scale = 1.0 / (a00 * c00 + a01 * c01 + a02 * c02)
    adjugate = (
        (c00, a02 * a21 - a01 * a22, a01 * a12 - a02 * a11),
        (c01, a00 * a22 - a02 * a20, a02 * a10 - a00 * a12),
        (c02, a01 * a20 - a00 * a21, a00 * a11 - a01 * a10),
    )
    return tuple(scale * value for value in matvec3(adjugate, b))


def solve_in_lanes(
    matrix: Float[Array, "row row lane"],
    rhs: Float[Array, "row lane"],
    is_needed: Bool[Array, "row lane"],
) -> Float[Array, "row lane"]:
    """Solve a dense system in every lane, by elimination without pivoting.

    The systems of this engine are close to symmetric and positive definite, where
    pivoting is not needed.

    Args:
        matrix: of each lane.
        rhs: of each lane.
        is_needed: false for a row that is a unit row with a right-hand side of zero;
            one that no lane needs costs next to nothing.

    Returns:
        The solution.
    """
    order, num = jnp.arange(matrix.shape[0]), matrix.shape[0]
    if num > _FEW_ROWS:
        counts = jnp.any(is_needed, axis=1)
        order = jnp.argsort(jnp.where(counts, 0, 1), stable=True)
        num = jnp.sum(counts)

    def times(x):
        return jnp.sum(matrix * x[None], axis=1)

    def solve(_, b):
        return _eliminated(matrix, b, order, num)

    def solve_transposed(_, b):
        return _eliminated(jnp.swapaxes(matrix, 0, 1), b, order, num)

    return jax.lax.custom_linear_solve(times, rhs, solve, solve_transposed)


def _eliminated(matrix, rhs, order, num):
    """Gauss and Jordan's elimination: every pass leaves a column of the unit matrix."""
    whole = jnp.concatenate([matrix, rhs[:, None]], axis=1)
    index = jnp.arange(matrix.shape[0])

    def clear(turn, whole):
        k = order[turn]
        pivots = jax.lax.dynamic_index_in_dim(whole, k, axis=0, keepdims=False)
        column = jax.lax.dynamic_index_in_dim(whole, k, axis=1, keepdims=False)
        inverse = 1.0 / jax.lax.dynamic_index_in_dim(pivots, k, 0, keepdims=False)
        is_pivot = (index == k)[:, None, None]
        scaled = inverse[None] * pivots
        return jnp.where(is_pivot, scaled[None], whole - column[:, None] * scaled[None])

    return jax.lax.fori_loop(0, num, clear, whole)[:, -1]
