"""Solutions that are searched for, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.searched import searched


def search(problem, given):
    """Square roots by Newton's method, and how many steps it took."""
    square, scale = problem

    def goes_on(carry):
        num, root = carry
        return (num < 60) & (jnp.abs(root**2 - scale * square) > 1e-6 * root**2)

    def advance(carry):
        num, root = carry
        return num + 1, newton(problem, root)

    num, root = jax.lax.while_loop(goes_on, advance, (jnp.zeros((), jnp.int32), given))
    return root, num


def newton(problem, root):
    square, scale = problem
    return 0.5 * (root + scale * square / root)


def step(problem, root, num):
    del num
    return newton(problem, root)


def root_of(square, scale, start=1.0):
    return searched(search, step, (square, scale), jnp.asarray(start))[0]


def test_the_solution_and_what_else_is_known():
    root, num = searched(
        search, step, (jnp.float32(9.0), jnp.float32(4.0)), jnp.float32(1.0)
    )
    np.testing.assert_allclose(root, 6.0, rtol=1e-6)
    assert 3 < num < 12


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_derivatives_are_those_of_the_solution(derivative):
    square, scale = jnp.float32(9.0), jnp.float32(4.0)
    # d sqrt(s p) by p and by s.
    by_square, by_scale = derivative(root_of, argnums=(0, 1))(square, scale)
    np.testing.assert_allclose(by_square, 0.5 * np.sqrt(4.0 / 9.0), rtol=1e-5)
    np.testing.assert_allclose(by_scale, 0.5 * np.sqrt(9.0 / 4.0), rtol=1e-5)


@pytest.mark.parametrize("outer", [jax.jacfwd, jax.jacrev])
def test_second_derivatives_too(outer):
    square, scale = jnp.float32(9.0), jnp.float32(4.0)
    second = outer(jax.jacfwd(root_of))(square, scale)
    np.testing.assert_allclose(second, -0.25 * 2.0 * 9.0**-1.5, rtol=1e-4)


def test_where_it_starts_has_no_derivative():
    slope = jax.jacfwd(lambda start: root_of(9.0, 4.0, start))(jnp.float32(1.0))
    assert slope == 0.0


def test_batches():
    squares = jnp.asarray([1.0, 4.0, 9.0, 1e4])
    roots = jax.vmap(lambda square: root_of(square, jnp.ones(())))(squares)
    slopes = jax.vmap(jax.grad(lambda square: root_of(square, jnp.ones(()))))(squares)
    np.testing.assert_allclose(roots, np.sqrt(squares), rtol=1e-5)
    np.testing.assert_allclose(slopes, 0.5 / np.sqrt(squares), rtol=1e-5)


def test_what_is_no_number_goes_with_the_problem_in_loops_and_lanes():
    def search_mixed(problem, given):
        square, scale, is_doubled, num, nothing = problem
        assert nothing is None
        factor = jnp.where(is_doubled, 2.0, 1.0) * num
        return search((square, scale * factor), given)

    def step_mixed(problem, root, num_steps):
        square, scale, is_doubled, num, _ = problem
        factor = jnp.where(is_doubled, 2.0, 1.0) * num
        return step((square, scale * factor), root, num_steps)

    def total(square):
        @jax.checkpoint
        def advance(carry, is_doubled):
            problem = (square, jnp.ones(()), is_doubled, jnp.asarray(4), None)
            return carry + searched(search_mixed, step_mixed, problem, 1.0)[0], None

        return jax.lax.scan(advance, 0.0, jnp.asarray([True, False]))[0]

    # sqrt(8 p) + sqrt(4 p).
    squares = jnp.asarray([1.0, 9.0])
    expected = (np.sqrt(8.0) + 2.0) * 0.5 / np.sqrt(squares)
    slopes = jax.jit(jax.vmap(jax.grad(total)))(squares)
    np.testing.assert_allclose(slopes, expected, rtol=1e-5)


def test_without_a_derivative_there_is_no_further_step():
    def steps_in(function):
        return str(jax.make_jaxpr(function)(jnp.float32(9.0))).count(" div ")

    value = steps_in(lambda square: root_of(square, jnp.float32(4.0)))
    rate = steps_in(jax.grad(lambda square: root_of(square, jnp.float32(4.0))))
    assert value == 1
    assert rate > 1
