"""Rows of joints in both of their forms, against matrices that NumPy multiplies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.holding import runtime_one
from boomdp_jax.physics.body_friction import BodyAnswer
from boomdp_jax.physics.joints import Rows
from boomdp_jax.physics.many_bodies import is_many
from boomdp_jax.physics.params import WORLD
from boomdp_jax.physics.row_algebra import (
    Levers,
    columns_of,
    coupled,
    ease_of,
    moved_by,
    pushed,
    speed,
    tied,
    with_arms,
)

NUM_BODIES, NUM_LANES = 4, 3
ENDS = [(0, 1), (2, WORLD), (3, 0), (1, WORLD), (1, 2), (2, 3), (0, WORLD), (3, 2)]


def random(rng, *shape):
    return jnp.asarray(rng.normal(size=(*shape, NUM_LANES)), jnp.float32)


def random_rows(rng) -> Rows:
    """Eight of them, one of which is not active."""
    num = len(ENDS)
    a, b = (np.array(end, np.float32) for end in zip(*ENDS, strict=True))
    is_on = np.ones(num)
    is_on[4] = 0.0
    has_b = is_on * (b != WORLD)

    def arms(on):
        return tuple(random(rng, num) * on[:, None].astype(np.float32) for _ in "xys")

    def spread(index):
        return jnp.broadcast_to(jnp.asarray(index)[:, None], (num, NUM_LANES))

    return Rows(spread(a), spread(b), arms(is_on), arms(has_b), random(rng, num))


def matrix_of(rows: Rows) -> np.ndarray:
    """`[lane, row, 3 * body]`."""
    out = np.zeros((NUM_LANES, len(ENDS), NUM_BODIES, 3))
    for row, (a, b) in enumerate(ENDS):
        for k in range(3):
            out[:, row, a, k] += np.asarray(rows.ja[k][row])
            if b != WORLD:
                out[:, row, b, k] += np.asarray(rows.jb[k][row])
    return out.reshape(NUM_LANES, len(ENDS), -1)


def vector_of(values) -> np.ndarray:
    """Three numbers of every body `[body, lane]`, as `[lane, 3 * body]`."""
    return np.stack(values, axis=1).reshape(-1, NUM_LANES).T


def random_answer(rng) -> BodyAnswer:
    return BodyAnswer(*random(rng, 3, NUM_BODIES), tuple(random(rng, 6, NUM_BODIES)))


def answer_matrix(answer: BodyAnswer) -> np.ndarray:
    """Block-diagonal, `[lane, 3 * body, 3 * body]`."""
    xy, yx, xs, sx, ys, sy = answer.mixed
    blocks = np.array(
        [[answer.xx, xy, xs], [yx, answer.yy, ys], [sx, sy, answer.spin]], float
    )
    out = np.zeros((NUM_LANES, NUM_BODIES, 3, NUM_BODIES, 3))
    for body in range(NUM_BODIES):
        out[:, body, :, body] = np.moveaxis(blocks[:, :, body], -1, 0)
    return out.reshape(NUM_LANES, 3 * NUM_BODIES, 3 * NUM_BODIES)


@pytest.fixture(params=["levers", "rows"])
def form(request):
    """From rows to what is tried."""
    if request.param == "rows":
        return lambda rows: rows
    return lambda rows: tied(rows, NUM_BODIES)


def close(found, expected):
    np.testing.assert_allclose(np.asarray(found).T, expected, rtol=1e-4, atol=1e-4)


def test_few_bodies_have_levers_and_many_do_not():
    rows = random_rows(np.random.default_rng(0))
    assert isinstance(tied(rows, NUM_BODIES), Levers)
    many = next(num for num in range(2, 50) if is_many(num))
    assert tied(rows, many) is rows


def test_speeds_and_impulses(form):
    rng = np.random.default_rng(1)
    rows, impulse = random_rows(rng), random(rng, len(ENDS))
    twist = tuple(random(rng, 3, NUM_BODIES))
    matrix = matrix_of(rows)
    expected = np.einsum("lrb,lb->lr", matrix, vector_of(twist))
    close(speed(form(rows), twist), expected)
    added = np.einsum("lrb,lr->lb", matrix, np.asarray(impulse).T)
    found = pushed(twist, form(rows), impulse)
    close(vector_of(found).T, vector_of(twist) + added)


def test_coupling_of_two_sets_of_rows(form):
    rng = np.random.default_rng(2)
    mid, end = random_rows(rng), random_rows(rng)
    answer, impulse = random_answer(rng), random(rng, len(ENDS))
    twist = tuple(random(rng, 3, NUM_BODIES))
    one = runtime_one(jnp.ones((NUM_BODIES, NUM_LANES)))
    columns = columns_of(form(mid), answer, one)
    push = answer_matrix(answer) @ np.swapaxes(matrix_of(mid), 1, 2)
    expected = matrix_of(end) @ push
    close(coupled(form(end), form(mid), columns), np.swapaxes(expected, 1, 2))
    moved = np.einsum("lbr,lr->lb", push, np.asarray(impulse).T)
    found = moved_by(twist, form(mid), columns, impulse)
    close(vector_of(found).T, vector_of(twist) + moved)


def test_a_body_tied_to_itself_feels_both_ends(form):
    """A scene does not allow it, parameters may say it."""
    rng = np.random.default_rng(6)
    rows, twist = random_rows(rng), tuple(random(rng, 3, NUM_BODIES))
    rows = rows._replace(b=jnp.where(rows.b == WORLD, rows.b, rows.a))
    expected = [
        sum(
            (np.asarray(rows.ja[k][row]) + np.asarray(rows.jb[k][row])) * twist[k][a]
            for k in range(3)
        )
        for row, (a, _) in enumerate(ENDS)
    ]
    close(speed(form(rows), twist), np.transpose(expected))


def test_ease(form):
    rng = np.random.default_rng(3)
    rows = random_rows(rng)
    light, spinning = jnp.abs(random(rng, 2, NUM_BODIES))
    inverse_mass = vector_of((light, light, spinning))
    expected = np.einsum("lrb,lb->lr", matrix_of(rows) ** 2, inverse_mass)
    close(ease_of(form(rows), light, spinning), expected)


def test_arms_of_several_rows(form):
    rng = np.random.default_rng(4)
    first, second = random_rows(rng), random_rows(rng)
    twist = tuple(random(rng, 3, NUM_BODIES))
    both = with_arms(jnp.subtract, form(first), form(second))
    expected = speed(form(first), twist) - speed(form(second), twist)
    close(speed(both, twist), np.asarray(expected).T)


def test_both_forms_have_derivatives(form):
    rng = np.random.default_rng(5)
    rows, answer = random_rows(rng), random_answer(rng)
    one = jnp.ones((NUM_BODIES, NUM_LANES))

    def total(answer):
        ours = form(rows)
        return jnp.sum(coupled(ours, ours, columns_of(ours, answer, one)))

    slope = jax.grad(total)(answer)
    # J A^-1 J^T summed over rows is quadratic in the sum of them.
    whole = matrix_of(rows).sum(axis=1).reshape(NUM_LANES, NUM_BODIES, 3)
    close(slope.xx, whole[..., 0] ** 2)
    close(slope.mixed[2], whole[..., 0] * whole[..., 2])
