"""Functions of scalars in one loop: plain JAX's numbers, in every transform."""

import functools
import os
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.one_loop import one_loop

NUM = 5


def float_type(precision):
    return precision.choose(single=jnp.float32, double=jnp.float64)


def chain(place, force):
    """Several results that share what they are made of."""
    x = place["x"] * force
    slow = jnp.sqrt(1.0 + x * x) / (1.0 + place["y"] ** 2)
    return {
        "product": x * slow,
        "gap": jnp.where(slow > 1.0, slow - force, jnp.round(force)),
        "same": place["y"] + 0.0 * x,
    }


def looped(place, force):
    return one_loop(chain, place, force)


def powers(exponent, base):
    return base**exponent


@pytest.fixture
def numbers(precision):
    keys = jax.random.split(jax.random.key(0), 3)
    draw = [jax.random.normal(key, (NUM,), float_type(precision)) for key in keys]
    return {"x": draw[0], "y": draw[1]}, draw[2]


@pytest.fixture
def close(precision):
    def check(one, other):
        tolerance = precision.choose(single=2e-6, double=1e-14)
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
            assert a.dtype == float_type(precision)
            assert a.shape == b.shape
            np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)

    return check


def row(tree, i):
    return jax.tree.map(lambda leaf: leaf[i], tree)


# How functions of a place and a force are batched; the last axis of both is the batch.
BATCHES = {
    "alone": (lambda f: lambda p, q: f(row(p, 0), q[0])),
    "both": (lambda f: jax.vmap(f)),
    "places only": (lambda f: lambda p, q: jax.vmap(f, (0, None))(p, q[0])),
    "forces only": (lambda f: lambda p, q: jax.vmap(f, (None, 0))(row(p, 1), q)),
    "table": (lambda f: jax.vmap(jax.vmap(f, (0, None)), (None, 0))),
    "table, one leaf shared": (
        lambda f: jax.vmap(
            jax.vmap(f, ({"x": None, "y": 0}, None)), ({"x": 0, "y": None}, 0)
        )
    ),
    "last axis out": (
        lambda f: lambda p, q: jax.vmap(jax.vmap(f, (0, None)), (None, 0), 1)(p, q)
    ),
}


@pytest.fixture(params=list(BATCHES))
def batched(request):
    return BATCHES[request.param]


def test_batched(batched, numbers, close):
    close(batched(looped)(*numbers), batched(chain)(*numbers))


def test_compiled(batched, numbers, close):
    close(jax.jit(batched(looped))(*numbers), batched(chain)(*numbers))


def total(f):
    return lambda *numbers: sum(
        jnp.sum(jnp.sin(leaf)) for leaf in jax.tree.leaves(f(*numbers))
    )


def test_reverse_mode(batched, numbers, close):
    one, other = (jax.grad(total(batched(f)), (0, 1)) for f in (looped, chain))
    close(one(*numbers), other(*numbers))


@pytest.mark.slow
def test_forward_mode(batched, numbers, close):
    one, other = (jax.jacfwd(batched(f), (0, 1)) for f in (looped, chain))
    close(one(*numbers), other(*numbers))


@pytest.mark.slow
def test_second_derivatives(batched, numbers, close):
    one, other = (jax.jit(jax.hessian(total(batched(f)))) for f in (looped, chain))
    close(one(*numbers), other(*numbers))
    one, other = (jax.jacrev(jax.grad(total(batched(f)))) for f in (looped, chain))
    close(one(*numbers), other(*numbers))


def test_gradients_in_a_batch(numbers, close):
    one, other = (
        jax.vmap(jax.value_and_grad(lambda p, q, f=f: f(p, q)["product"]))
        for f in (looped, chain)
    )
    close(one(*numbers), other(*numbers))


@pytest.mark.parametrize("wrap", [lambda f: f, jax.checkpoint])
def test_in_a_loop_over_time(numbers, close, wrap):
    def travel(f):
        def run(place, force):
            def advance(x, _):
                out = jax.vmap(f)({"x": x, "y": place["y"]}, force)
                return 0.5 * out["gap"], out["product"]

            return jax.lax.scan(wrap(advance), place["x"], None, length=6)[1]

        return jax.grad(total(run), (0, 1))

    close(travel(looped)(*numbers), travel(chain)(*numbers))


def test_by_several_devices_of_a_mesh(numbers, close):
    mesh = jax.sharding.Mesh(np.array(jax.devices("cpu")[:1]), ("batch",))
    spec = jax.sharding.PartitionSpec("batch")
    spread = jax.shard_map(
        jax.vmap(looped), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False
    )
    close(spread(*numbers), jax.vmap(chain)(*numbers))


def test_without_compilation(numbers, close):
    with jax.disable_jit():
        found = jax.vmap(looped)(*numbers)
    close(found, jax.vmap(chain)(*numbers))


def test_static_arguments_and_more_results_than_arguments(precision):
    base = jnp.arange(1.0, 4.0, dtype=float_type(precision))
    for exponent in (2, 3):
        found = jax.vmap(lambda b, e=exponent: one_loop(powers, b, static=(e,)))(base)
        np.testing.assert_allclose(found, np.arange(1.0, 4.0) ** exponent)

    many = jax.vmap(lambda b: one_loop(three_of_one, b))(base)
    np.testing.assert_allclose(np.stack(many), [[1, 2, 3], [2, 4, 6], [1, 4, 9]])


def three_of_one(base):
    return base, 2.0 * base, base * base


def test_it_is_one_loop_when_compiled():
    """Without it, what several results share is stored in between."""
    numbers = [jnp.ones(4096, jnp.float32) for _ in range(3)]

    def loops(f):
        program = jax.jit(jax.vmap(lambda x, y, q: f({"x": x, "y": y}, q)))
        # As users' programs are compiled, where tests are not.
        is_quick = "xla_cpu_use_fusion_emitters" in os.environ.get("XLA_FLAGS", "")
        options = {"xla_cpu_use_fusion_emitters": True} if is_quick else {}
        text = program.lower(*numbers).compile(options).as_text()
        lines = text[text.index("ENTRY") :].splitlines()
        return sum(" fusion(" in line and "f32[4096" in line for line in lines)

    assert loops(looped) == 1 < loops(chain)


@pytest.mark.parametrize(
    ("shape", "is_sorted"),
    [((64,), True), ((1, 64), True), ((8, 8), True), ((4,), False), ((2, 2), False)],
)
def test_loops_over_time_are_not_merged_for_many(shape, is_sorted):
    """A sort keeps the backend from writing them as one slow function (`unmerged`)."""
    batched = functools.reduce(lambda f, _: jax.vmap(f), shape, looped)

    def run(place, force):
        def advance(x, _):
            out = batched({"x": x, "y": place["y"]}, force)
            return 0.5 * out["gap"], out["product"]

        return jax.lax.scan(advance, place["x"], None, length=6)[1]

    numbers = 0.1 * jnp.arange(3 * np.prod(shape), dtype=jnp.float32)
    x, y, force = numbers.reshape(3, *shape)
    for function in (run, jax.grad(lambda p, f: jnp.sum(run(p, f)))):
        text = jax.jit(function).lower({"x": x, "y": y}, force).compile().as_text()
        assert (" sort(" in text) == is_sorted


def test_traced_once_for_each_tree_of_arguments():
    count = []

    def counted(x, y):
        count.append(x)
        return x + y

    for _ in range(3):
        jax.vmap(lambda x: one_loop(counted, x, 1.0))(jnp.ones(3))
    assert len(count) == 1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: one_loop(chain, {"x": jnp.ones(2), "y": 1.0}, 1.0), "shape (2,)"),
        (lambda: one_loop(chain, {"x": 1, "y": 2}, 3), "floating numbers, got int"),
        (lambda: one_loop(lambda x: x > 0, 1.0), "got bool"),
        (lambda: one_loop(lambda x: x + jnp.ones(3), 1.0), "[3]"),
        (lambda: one_loop(lambda: 1.0), "at least one number"),
        (
            lambda: jax.jit(lambda z: one_loop(lambda x: x * z, 1.0))(2.0),
            "traced value from outside",
        ),
    ],
)
def test_what_it_cannot_take(call, message):
    with pytest.raises(TypeError, match=re.escape(message)):
        call()


def _two_turns(function, shared, start):
    """Two calls that share an argument, and its own use afterwards."""
    first = function(shared, {"x": start, "y": 0.5 * start})
    second = function(shared, {"x": first["gap"], "y": first["product"]})
    return second["product"] + second["same"] * jnp.cos(shared)


def _handed_on(shared, start):
    shared, first = _turn(shared, {"x": start, "y": 0.5 * start})
    shared, second = _turn(shared, {"x": first["gap"], "y": first["product"]})
    return second["product"] + second["same"] * jnp.cos(shared)


def _turned(shared, place):
    return chain(place, shared)


def _turn(shared, place):
    return one_loop(_turned, shared, place, num_passed=1)


@pytest.mark.slow
@pytest.mark.parametrize("is_scalar", [False, True])
def test_an_argument_handed_on_is_what_it_was(numbers, close, is_scalar):
    """Numbers and derivatives do not depend on who hands an argument on."""
    start, shared = numbers[0]["x"], numbers[1]
    axes = (None, 0) if is_scalar else (0, 0)
    shared = shared[0] if is_scalar else shared

    def total(function):
        def of_batch(shared, start):
            return jnp.sum(jax.vmap(function, axes)(shared, start) ** 2)

        return of_batch

    plain, passed = (
        total(function)
        for function in (lambda s, x: _two_turns(_turned, s, x), _handed_on)
    )
    for transform in (
        lambda f: f,
        lambda f: jax.grad(f, argnums=0),
        lambda f: jax.grad(f, argnums=(0, 1)),
        lambda f: jax.jacfwd(f, argnums=(0, 1)),
        lambda f: jax.jacfwd(jax.grad(f, argnums=(0, 1)), argnums=(0, 1)),
    ):
        close(*(jax.jit(transform(f))(shared, start) for f in (passed, plain)))
        if not is_scalar:
            close(*(transform(f)(shared, start) for f in (passed, plain)))


def test_what_is_given_back_for_an_argument_handed_on_is_added_up_inside(numbers):
    """That is what it is for: no loop of its own for each sum."""

    def additions(function):
        def total(shared, start):
            return jnp.sum(jax.vmap(function)(shared, start))

        program = jax.make_jaxpr(jax.grad(total))(numbers[1], numbers[0]["x"])
        return str(program).count("add_any")

    plain = additions(lambda s, x: _two_turns(lambda *a: one_loop(_turned, *a), s, x))
    # What is left is the use after both calls.
    assert additions(_handed_on) < plain
