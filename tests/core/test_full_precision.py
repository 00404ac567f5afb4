"""The decorator that keeps all bits of products, and the search that looks for others.

On CPUs it makes no difference, so only a trace tells.
"""

import concurrent.futures
import threading
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.core.lanes import in_lanes
from boomdp_jax.core.one_loop import one_loop
from boomdp_jax.core.quick_compile import QuickCompile
from tests.products import check, products


@pytest.fixture(autouse=True)
def _single_precision() -> Iterator[None]:
    """As GPUs are used."""
    with jax.enable_x64(False):
        yield


def square(x):
    return x @ x


def square_in_lanes(x):
    return jnp.einsum("ijl,jkl->ikl", x, x)


MATRIX = np.eye(3, dtype=np.float32)


def in_a_loop(x):
    return jax.lax.scan(lambda carry, _: (square(carry), None), x, None, length=2)[0]


def in_a_branch(x):
    return jax.lax.cond(x[0, 0] > 0, square, lambda x: x, x)


def while_it_is_small(x):
    return jax.lax.while_loop(lambda x: x[0, 0] < 2.0, square, x)


def of_a_solve(x):
    return jax.lax.custom_linear_solve(
        lambda y: x @ y, x[0], lambda _, y: x @ y, symmetric=True
    )


@jax.custom_jvp
def with_a_rule(x):
    return square(x)


with_a_rule.defjvp(lambda primals, tangents: (square(*primals), square(*tangents)))


@jax.custom_vjp
def with_a_rule_back(x):
    return square(x)


with_a_rule_back.defvjp(lambda x: (square(x), x), lambda x, rate: (x @ rate,))

PLANTED = {
    "plain": square,
    "compiled": jax.jit(square),
    "batched": lambda x: jax.vmap(square)(x[None]),
    "loop": in_a_loop,
    "branch": in_a_branch,
    "open loop": while_it_is_small,
    "solve": of_a_solve,
    "stored less": jax.checkpoint(square),
    "own tangent": with_a_rule,
    "own gradient": with_a_rule_back,
    "rule of a tangent": lambda x: jax.jvp(with_a_rule, (x,), (x,))[1],
    "rule of a gradient": lambda x: jax.vjp(with_a_rule_back, x)[1](x)[0],
    "lanes": lambda x: in_lanes(square_in_lanes, x),
    "gradient in lanes": jax.grad(lambda x: in_lanes(square_in_lanes, x)[0, 0]),
    "one loop": lambda x: one_loop(
        lambda y: jax.lax.dot_general(y, y, (((), ()), ((), ()))), x[0, 0]
    ),
}


@pytest.mark.parametrize("name", PLANTED)
def test_a_product_that_is_planted_is_found(name):
    found = products(PLANTED[name], MATRIX)
    assert found
    assert not any(is_full for is_full, _ in found)


@full_precision
def full_square(x):
    """Of a matrix."""
    return square(x)


@full_precision
def full_square_in_lanes(x):
    return square_in_lanes(x)


class Squared(eqx.Module):
    matrix: Any

    @full_precision
    def __call__(self):
        return square(self.matrix)

    @property
    @full_precision
    def twice(self):
        return square(self())


WRAPPED = {
    "plain": full_square,
    "compiled": jax.jit(full_square),
    "around what is compiled": full_precision(jax.jit(square)),
    "batched": lambda x: jax.vmap(full_square)(x[None]),
    "around a batch": full_precision(lambda x: jax.vmap(square)(x[None])),
    "loop": full_precision(in_a_loop),
    "branch": full_precision(in_a_branch),
    "open loop": full_precision(while_it_is_small),
    "stored less": jax.checkpoint(full_square),
    "gradient": jax.grad(lambda x: jnp.sum(full_square(x) ** 2)),
    "gradient of what is compiled": jax.grad(
        lambda x: jnp.sum(jax.jit(full_square)(x) ** 2)
    ),
    "around a gradient": full_precision(
        jax.grad(lambda x: jnp.sum(with_a_rule_back(x)))
    ),
    "curvature": jax.hessian(lambda x: jnp.sum(full_square(x) ** 2)),
    "lanes": lambda x: in_lanes(full_square_in_lanes, x),
    "gradient in lanes": jax.grad(lambda x: in_lanes(full_square_in_lanes, x)[0, 0]),
    "method": lambda x: Squared(x)(),
    "property": lambda x: Squared(x).twice,
}


@pytest.mark.parametrize("name", WRAPPED)
def test_products_of_a_wrapped_function_have_all_bits(name):
    check(WRAPPED[name], MATRIX)


def test_what_comes_after_a_wrapped_function_is_as_before():
    def twice(x):
        return square(full_square(square(x)))

    assert [is_full for is_full, _ in products(twice, MATRIX)] == [False, True, False]

    @full_precision
    def fail():
        raise ValueError("no number")

    with pytest.raises(ValueError, match="no number"):
        fail()
    assert not any(is_full for is_full, _ in products(square, MATRIX))


def test_a_wrapped_function_keeps_its_name_and_can_be_compiled_quickly():
    assert full_square.__name__ == "full_square"
    assert full_square.__doc__ == "Of a matrix."

    def shifted(x, by):
        return x @ x + by

    compiled = QuickCompile(full_precision(shifted), static=("by",))
    np.testing.assert_array_equal(compiled(MATRIX, by=1), MATRIX + 1)


def test_threads_do_not_disturb_each_other():
    barrier = threading.Barrier(2, timeout=60)

    @full_precision
    def meet(x):
        # Both are inside, and leave in the order in which they came.
        barrier.wait()
        return square(x)

    def trace(function):
        return [is_full for is_full, _ in products(function, MATRIX)]

    def one(_):
        return trace(meet), trace(square)

    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        for inside, outside in pool.map(one, range(2)):
            assert inside == [True]
            assert outside == [False]
