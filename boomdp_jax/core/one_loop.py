r"""Scalar functions of many batch elements in one loop.

XLA's CPU backend makes a loop over the batch of every few operations of a long chain of
arithmetic that has several results, and stores what lies between. A step of physics
becomes sixty loops that wait for memory most of the time. It has one operation,
though, that takes a function of several scalars to several scalars and applies it
element by element: a windowed reduction, here with a window of one element. The whole
function then becomes the body of one vectorised loop whose intermediate values stay in
registers: twice as fast on one core as the sixty loops on two, and compiled in a third
of the time (measured on one step of a body with pin and wheel).

That the function of such a reduction is applied exactly once, to the initial value and
the element, is how the backend works and not what its specification promises; it is
tried out once in every process, and where it does not hold, and on other backends, the
function is applied as everywhere else in JAX.

Derivatives are functions of the same kind: the tangent of a function, and its
transpose, take its arguments and work out what they need again, in registers, so that
a reverse pass stores the arguments of each call and nothing else.
"""

import dataclasses
import functools
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import jax
import jax.core
import jax.extend
import jax.numpy as jnp
import numpy as np
from jax.interpreters import ad, batching, mlir

from boomdp_jax.core.scalar_parts import parts_of


@dataclasses.dataclass(frozen=True, eq=False)
class _Body:
    """A function of scalars; the last `num_linear` of them it is linear in."""

    jaxpr: Any = dataclasses.field(repr=False)
    num_linear: int = 0

    @property
    def dtypes(self) -> list[np.dtype]:
        """Of the arguments."""
        return [aval.dtype for aval in self.jaxpr.in_avals]

    @property
    def function(self) -> Callable[..., list]:
        """What it computes."""
        return jax.extend.core.jaxpr_as_fun(self.jaxpr)


_one_loop_p = jax.extend.core.Primitive("one_loop")
_one_loop_p.multiple_results = True


def one_loop(
    function: Callable[..., Any], *arguments: Any, static: tuple[Hashable, ...] = ()
) -> Any:
    """Apply a function of scalars, as one loop wherever it is batched.

    Args:
        function: from scalars to a tree of scalars, by arithmetic alone: no loop whose
            length is not known, no array, no traced value from outside. Traced once
            for each tree of arguments; to be defined at module level, since it is
            remembered.
        arguments: trees of scalars of one floating type.
        static: what the function takes before its arguments, hashable.

    Returns:
        What the function returns. Batched by `jax.vmap` like anything else, and
        differentiable in both modes, any number of times.

    Raises:
        TypeError: if an argument or a result is not a scalar of that type.
    """
    leaves, treedef = jax.tree.flatten(arguments)
    if not leaves:
        raise TypeError("one_loop needs at least one number among its arguments")
    dtype = jnp.result_type(*leaves)
    if not jnp.issubdtype(dtype, jnp.floating):
        raise TypeError(f"one_loop works on floating numbers, got {dtype}")
    for leaf in leaves:
        if jnp.shape(leaf):
            raise TypeError(
                f"one_loop works on scalars, got an array of shape {jnp.shape(leaf)}"
            )
    is_double = jnp.result_type(float) == jnp.float64
    body, tree_out = _traced(function, static, treedef, np.dtype(dtype), is_double)
    flat = [jnp.asarray(leaf, dtype) for leaf in leaves]
    return jax.tree.unflatten(tree_out, _one_loop_p.bind(*flat, body=body))


def elementwise(
    function: Callable[..., Any], *arguments: Any, static: tuple[Hashable, ...] = ()
) -> Any:
    """Apply a function of scalars to arrays, element by element, as one loop.

    Args:
        function: as for `one_loop`.
        arguments: trees of arrays; those of fewer axes are spread over leading ones.
        static: what the function takes before its arguments, hashable.

    Returns:
        A tree of arrays of their common shape.
    """
    leaves, treedef = jax.tree.flatten(arguments)
    dtype = jnp.result_type(*leaves)
    leaves = [jnp.asarray(leaf, dtype) for leaf in leaves]
    shape = jnp.broadcast_shapes(*(leaf.shape for leaf in leaves))

    def apply(*scalars):
        return one_loop(function, *jax.tree.unflatten(treedef, scalars), static=static)

    for _ in shape:
        apply = jax.vmap(apply)
    # Leading axes are written out: rank promotion may be switched off.
    leaves = [
        leaf.reshape((1,) * (len(shape) - leaf.ndim) + leaf.shape) for leaf in leaves
    ]
    leaves = [jnp.broadcast_to(leaf, shape) for leaf in leaves]
    return apply(*leaves)


@functools.lru_cache(maxsize=256)
def _traced(function, static, treedef, dtype, is_double):
    """The function as a body, and the tree of its results."""
    del is_double  # A key of the cache: it decides the type of indices.
    tree_out = []

    def flat(*leaves):
        out, tree = jax.tree.flatten(
            function(*static, *jax.tree.unflatten(treedef, leaves))
        )
        tree_out[:] = [tree]
        return [jnp.asarray(leaf) for leaf in out]

    jaxpr = _jaxpr_of(flat, [dtype] * treedef.num_leaves)
    for aval in jaxpr.out_avals:
        if aval.shape or aval.dtype != dtype:
            raise TypeError(
                f"a function for one_loop returns scalars of type {dtype}, got "
                f"{aval.dtype}{list(aval.shape)}"
            )
    return _Body(jaxpr), tree_out[0]


def _jaxpr_of(function, dtypes):
    shapes = [jax.ShapeDtypeStruct((), dtype) for dtype in dtypes]
    jaxpr = jax.make_jaxpr(function)(*shapes)
    for const in jaxpr.consts:
        if isinstance(const, jax.core.Tracer):
            raise TypeError(
                "a function for one_loop takes what it depends on as arguments, got "
                f"a traced value from outside: {const}"
            )
    if jaxpr.consts:
        # The body of a reduction has no constants beside those written in it.
        inner, values = jaxpr.jaxpr, [np.asarray(c)[()] for c in jaxpr.consts]
        jaxpr = jax.make_jaxpr(
            lambda *numbers: jax.core.eval_jaxpr(inner, values, *numbers)
        )(*shapes)
    return jaxpr


@_one_loop_p.def_abstract_eval
def _shapes(*avals, body):
    shape = _common_shape(avals)
    return [jax.core.ShapedArray(shape, aval.dtype) for aval in body.jaxpr.out_avals]


def _common_shape(arrays) -> tuple[int, ...]:
    """The one shape of all that are not scalars."""
    shapes = {tuple(a.shape) for a in arrays} - {()}
    if len(shapes) > 1:
        raise TypeError(f"one_loop got arrays of different shapes: {sorted(shapes)}")
    return shapes.pop() if shapes else ()


@functools.lru_cache(maxsize=256)
def _parts(body):
    return parts_of(body.jaxpr)


@functools.lru_cache(maxsize=256)
def _compiled(body):
    def run(*arguments):
        if any(isinstance(a, jax.core.Tracer) for a in arguments):
            return _one_loop_p.bind(*arguments, body=body)
        # Compilation is switched off.
        return [jnp.asarray(leaf) for leaf in _by_vmap(*arguments, body=body)]

    return jax.jit(run)


@_one_loop_p.def_impl
def _run(*arguments, body):
    return _compiled(body)(*arguments)


def _batched(arguments: Sequence, dims: Sequence, *, body):
    """Scalars that are not batched stay scalars; everything else gets one shape."""
    size = next(
        a.shape[d] for a, d in zip(arguments, dims, strict=True) if d is not None
    )
    moved = [
        a if d is None else jnp.moveaxis(a, d, 0)
        for a, d in zip(arguments, dims, strict=True)
    ]
    inner = _common_shape(
        [
            jax.ShapeDtypeStruct(a.shape if d is None else a.shape[1:], a.dtype)
            for a, d in zip(moved, dims, strict=True)
        ]
    )

    def spread(array, is_batched: bool):
        if not is_batched and not array.shape:
            return array
        if is_batched and len(array.shape) == 1:
            array = array.reshape(size, *(1 for _ in inner))
        return jnp.broadcast_to(array, (size, *inner))

    spreads = [spread(a, d is not None) for a, d in zip(moved, dims, strict=True)]
    out = _one_loop_p.bind(*spreads, body=body)
    return out, [0] * len(out)


batching.primitive_batchers[_one_loop_p] = _batched


@functools.lru_cache(maxsize=256)
def _tangent(body: _Body, active: tuple[int, ...]) -> _Body:
    """From arguments and tangents of the active ones to tangents of the results."""
    dtypes = body.dtypes

    def tangent(*values):
        primals, rates = list(values[: len(dtypes)]), list(values[len(dtypes) :])

        def of_active(*chosen):
            full = list(primals)
            for i, value in zip(active, chosen, strict=True):
                full[i] = value
            return body.function(*full)

        return jax.jvp(of_active, [primals[i] for i in active], rates)[1]

    jaxpr = _jaxpr_of(tangent, dtypes + [dtypes[i] for i in active])
    return _Body(jaxpr, num_linear=len(active))


@functools.lru_cache(maxsize=256)
def _transposed(body: _Body, present: tuple[int, ...]) -> _Body:
    """From other arguments and cotangents of some results to those of linear ones."""
    dtypes = body.dtypes
    num = len(dtypes) - body.num_linear

    def transposed(*values):
        others, cotangents = values[:num], list(values[num:])

        def linear(*chosen):
            out = body.function(*others, *chosen)
            return [out[i] for i in present]

        shapes = [jax.ShapeDtypeStruct((), dtype) for dtype in dtypes[num:]]
        return list(jax.linear_transpose(linear, *shapes)(cotangents))

    given = [body.jaxpr.out_avals[i].dtype for i in present]
    return _Body(_jaxpr_of(transposed, dtypes[:num] + given), num_linear=len(present))


def _jvp(primals, tangents, *, body):
    out = _one_loop_p.bind(*primals, body=body)
    active = tuple(i for i, t in enumerate(tangents) if type(t) is not ad.Zero)
    first = len(primals) - body.num_linear
    if active[0] >= first:
        rates = [
            # A scalar will do for one that does not move.
            jnp.zeros((), p.dtype) if type(t) is ad.Zero else t
            for p, t in zip(primals[first:], tangents[first:], strict=True)
        ]
        moved = _one_loop_p.bind(*primals[:first], *rates, body=body)
    else:
        rates = [tangents[i] for i in active]
        moved = _one_loop_p.bind(*primals, *rates, body=_tangent(body, active))
    # Tangents of a batch's scalars may be scalars still.
    return out, [
        m if m.shape == o.shape else jnp.broadcast_to(m, o.shape)
        for m, o in zip(moved, out, strict=True)
    ]


ad.primitive_jvps[_one_loop_p] = _jvp


def _transpose(cotangents, *arguments, body):
    num = len(arguments) - body.num_linear
    others, linear = arguments[:num], arguments[num:]
    present = tuple(i for i, ct in enumerate(cotangents) if type(ct) is not ad.Zero)
    if not present:
        return [
            ad.Zero(a.aval) if ad.is_undefined_primal(a) else None for a in arguments
        ]
    given = [cotangents[i] for i in present]
    out = _one_loop_p.bind(*others, *given, body=_transposed(body, present))
    return [None] * num + [
        # What went out to a whole batch comes back as a sum.
        (jnp.sum(ct) if ct.shape != tuple(a.aval.shape) else ct)
        if ad.is_undefined_primal(a)
        else None
        for ct, a in zip(out, linear, strict=True)
    ]


ad.primitive_transposes[_one_loop_p] = _transpose


def _by_vmap(*arguments, body):
    """As everywhere else in JAX."""
    shape = _common_shape(arguments)
    if not shape:
        return body.function(*arguments)
    flat = [a.reshape(-1) if a.shape else a for a in arguments]
    axes = tuple(0 if a.shape else None for a in arguments)
    out = jax.vmap(body.function, axes, axis_size=int(np.prod(shape)))(*flat)
    return [leaf.reshape(shape) for leaf in out]


def _by_reduction(*arguments, body):
    """As functions of windowed reductions."""
    shape, values, out = _common_shape(arguments), list(arguments), []
    for part in _parts(body):
        out = _reduction(
            part.function, [values[i] for i in part.inputs], part.num_outputs
        )
        values += out
    # A result that depends on scalars alone is one.
    return [jnp.broadcast_to(leaf, shape) for leaf in out]


def _reduction(function, arguments: list, num_out: int) -> list:
    """A function of a windowed reduction; scalars travel as initial values."""
    shape, dtype = _common_shape(arguments), arguments[0].dtype
    is_array = [bool(a.shape) for a in arguments]
    arrays = [a.reshape(-1) for a in arguments if a.shape]
    scalars = [a for a in arguments if not a.shape]
    num_slots = max(len(arrays), len(scalars), num_out)
    spare = arrays[0] if arrays else jnp.zeros((1,), dtype)
    zero = jnp.zeros((), dtype)
    arrays += [spare] * (num_slots - len(arrays))
    scalars += [zero] * (num_slots - len(scalars))

    def apply(initial, element):
        sources = {True: iter(element), False: iter(initial)}
        out = function(*(next(sources[is_one]) for is_one in is_array))
        return (*out, *(jnp.zeros((), dtype),) * (num_slots - num_out))

    out = jax.lax.reduce_window(
        tuple(arrays), tuple(scalars), apply, (1,), (1,), "VALID"
    )
    return [leaf.reshape(shape) for leaf in out[:num_out]]


@functools.cache
def _is_applied_once() -> bool:
    """Whether the CPU backend applies the function of a reduction as is needed here."""
    first, second = np.array([[1.0, 2.0, -3.0], [0.5, -4.0, 7.0]], np.float32)

    def apply(initial, element):
        return initial[0] - 2.0 * element[0] * element[1], initial[1] + element[1] ** 3

    def reduce(first, second, start):
        return jax.lax.reduce_window(
            (first, second), (start, 2.0 * start), apply, (1,), (1,), "VALID"
        )

    expected = (5.0 - 2.0 * first * second, 10.0 + second**3)
    with (
        jax.ensure_compile_time_eval(),
        jax.disable_jit(False),
        jax.default_device(jax.devices("cpu")[0]),
    ):
        found = jax.jit(reduce)(first, second, np.float32(5.0))
        return all(np.array_equal(f, e) for f, e in zip(found, expected, strict=True))


def _on_cpu(context, *arguments, **params):
    rule = _by_reduction if _is_applied_once() else _by_vmap
    return mlir.lower_fun(rule, multiple_results=True)(context, *arguments, **params)


mlir.register_lowering(_one_loop_p, mlir.lower_fun(_by_vmap, multiple_results=True))
mlir.register_lowering(_one_loop_p, _on_cpu, platform="cpu")
