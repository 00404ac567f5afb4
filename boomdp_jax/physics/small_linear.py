"""Small linear solves written out in scalars, which is what fuses and vectorises."""

import jax.numpy as jnp

# Above this many rows the written-out elimination compiles too slowly.
_UNROLLED_ROWS = 14


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


def solve_rows(s, rhs):
    """Solve a small dense system by elimination without pivoting.

    The systems of this engine are close to symmetric and positive definite, where
    pivoting is not needed.

    Args:
        s: list of rows, each a list of scalar arrays.
        rhs: list of scalar arrays.

    Returns:
        The solution, a list of scalar arrays.
    """
    num = len(rhs)
    if num == 0:
        return []
    if num == 1:
        return [rhs[0] / s[0][0]]
    if num == 2:
        scale = 1.0 / (s[0][0] * s[1][1] - s[0][1] * s[1][0])
        return [
            (s[1][1] * rhs[0] - s[0][1] * rhs[1]) * scale,
            (s[0][0] * rhs[1] - s[1][0] * rhs[0]) * scale,
        ]
    if num > _UNROLLED_ROWS:
        matrix = jnp.stack([jnp.stack(row) for row in s])
        return list(jnp.linalg.solve(matrix, jnp.stack(rhs)))
    s, rhs = [list(row) for row in s], list(rhs)
    for k in range(num):
        pivot = 1.0 / s[k][k]
        for i in range(k + 1, num):
            factor = s[i][k] * pivot
            for j in range(k + 1, num):
                s[i][j] = s[i][j] - factor * s[k][j]
            rhs[i] = rhs[i] - factor * rhs[k]
    solution = [None] * num
    for k in reversed(range(num)):
        total = rhs[k]
        for j in range(k + 1, num):
            total = total - s[k][j] * solution[j]
        solution[k] = total / s[k][k]
    return solution


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
