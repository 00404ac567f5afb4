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

from boomdp_jax.core.dependence import depends_on
from boomdp_jax.core.loop_code import (
    by_reduction,
    by_vmap,
    common_shape,
    is_applied_once,
)


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
    function: Callable[..., Any],
    *arguments: Any,
    static: tuple[Hashable, ...] = (),
    num_passed: int = 0,
    is_marked: bool = True,
) -> Any:
    """Apply a function of scalars, as one loop wherever it is batched.

    Where many calls share an argument a reverse pass adds up what each gives back for
    it, a small loop for every sum. If each call takes the argument from the one before,
    handed on unchanged (`num_passed`), they are added up within the loops of the calls.

    Args:
        function: from scalars to a tree of scalars, by arithmetic alone: no loop whose
            length is not known, no array, no traced value from outside. Traced once
            for each tree of arguments; to be defined at module level, since it is
            remembered.
        arguments: trees of scalars of one floating type.
        static: what the function takes before its arguments, hashable.
        num_passed: so many arguments, the first ones, are handed on.
        is_marked: whether a loop that this is worked out in is to be kept from being
            merged (`unmerged`). One mark is enough for a loop, and for those round it;
            derivatives are marked anyway.

    Returns:
        What the function returns; and before it those arguments, if there are any that
        are handed on. Batched by `jax.vmap` like anything else, and differentiable in
        both modes, any number of times.

    Raises:
        TypeError: if an argument or a result is not a scalar of that type.
    """
    leaves, treedef = jax.tree.flatten(arguments)
    if not leaves:
        raise TypeError("one_loop needs at least one number among its arguments")
    dtype = jnp.result_type(*leaves)
    if not jnp.issubdtype(dtype, jnp.floating):
        raise TypeError(f"one_loop works on floating numbers, got {dtype}")
    for shape in map(jnp.shape, leaves):
        if shape:
            raise TypeError(f"one_loop works on scalars, got an array of shape {shape}")
    is_double = jnp.result_type(float) == jnp.float64
    body, tree_out = _traced(function, static, treedef, np.dtype(dtype), is_double)
    flat = [jnp.asarray(leaf, dtype) for leaf in leaves]
    handed_on, treedef_on = jax.tree.flatten(arguments[:num_passed])
    passed = tuple(range(len(handed_on)))
    out = _one_loop_p.bind(*flat, body=body, passed=passed, is_marked=is_marked)
    num = len(body.jaxpr.out_avals)
    result = jax.tree.unflatten(tree_out, out[:num])
    if not num_passed:
        return result
    return (*jax.tree.unflatten(treedef_on, out[num:]), result)


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
def _shapes(*avals, body, passed, **_):
    """Of the results, and of what is handed on."""
    shape = common_shape(avals)
    results = [jax.core.ShapedArray(shape, aval.dtype) for aval in body.jaxpr.out_avals]
    return [*results, *(avals[i] for i in passed)]


@functools.lru_cache(maxsize=256)
def _compiled(**params):
    def run(*arguments):
        if any(isinstance(a, jax.core.Tracer) for a in arguments):
            return _one_loop_p.bind(*arguments, **params)
        # Compilation is switched off.
        out = by_vmap(*arguments, **params)
        return [jnp.asarray(leaf) for leaf in out]

    return jax.jit(run)


@_one_loop_p.def_impl
def _run(*arguments, **params):
    return _compiled(**params)(*arguments)


def _batched(arguments: Sequence, dims: Sequence, *, body, passed, **mark):
    """Scalars that are not batched stay scalars; everything else gets one shape."""
    size = next(
        a.shape[d] for a, d in zip(arguments, dims, strict=True) if d is not None
    )
    moved = [
        a if d is None else jnp.moveaxis(a, d, 0)
        for a, d in zip(arguments, dims, strict=True)
    ]
    inner = common_shape(
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
    # What had to be spread for this is handed on as it was, from here.
    inside = [i for i in passed if spreads[i].shape == moved[i].shape]
    out = _one_loop_p.bind(*spreads, body=body, passed=tuple(inside), **mark)
    num = len(out) - len(inside)
    handed_on = dict(zip(inside, out[num:], strict=True))
    out = out[:num] + [handed_on.get(i, moved[i]) for i in passed]
    return out, [0] * num + [None if dims[i] is None else 0 for i in passed]


batching.primitive_batchers[_one_loop_p] = _batched


@functools.lru_cache(maxsize=256)
def _tangent(body: _Body, active: tuple[int, ...]) -> _Body:
    """From arguments and tangents of the active ones to tangents of moving results."""
    dtypes, moving = body.dtypes, _moving_results(body, active)

    def tangent(*values):
        primals, rates = list(values[: len(dtypes)]), list(values[len(dtypes) :])

        def of_active(*chosen):
            full = list(primals)
            for i, value in zip(active, chosen, strict=True):
                full[i] = value
            return body.function(*full)

        out = jax.jvp(of_active, [primals[i] for i in active], rates)[1]
        return [rate for rate, is_moving in zip(out, moving, strict=True) if is_moving]

    jaxpr = _jaxpr_of(tangent, dtypes + [dtypes[i] for i in active])
    return _Body(jaxpr, num_linear=len(active))


@functools.lru_cache(maxsize=256)
def _transposed(
    body: _Body, present: tuple[int, ...], added: tuple[int, ...] = ()
) -> _Body:
    """From other arguments and cotangents of some results to those of linear ones.

    To those of the linear arguments that `added` counts up others are added, which come
    last.
    """
    dtypes = body.dtypes
    num = len(dtypes) - body.num_linear
    given = [body.jaxpr.out_avals[i].dtype for i in present]

    def transposed(*values):
        others, values = values[:num], values[num:]
        cotangents, more = list(values[: len(present)]), values[len(present) :]

        def linear(*chosen):
            out = body.function(*others, *chosen)
            return [out[i] for i in present]

        shapes = [jax.ShapeDtypeStruct((), dtype) for dtype in dtypes[num:]]
        out = list(jax.linear_transpose(linear, *shapes)(cotangents))
        for i, value in zip(added, more, strict=True):
            out[i] = out[i] + value
        return out

    dtypes_in = dtypes[:num] + given + [dtypes[num + i] for i in added]
    return _Body(_jaxpr_of(transposed, dtypes_in), len(given) + len(added))


@functools.lru_cache(maxsize=256)
def _moving_results(body: _Body, active: tuple[int, ...]) -> tuple[bool, ...]:
    """Which results have a derivative by the active arguments."""
    num = len(body.jaxpr.in_avals)
    return depends_on(body.jaxpr.jaxpr, [i in active for i in range(num)])


def _jvp(primals, tangents, *, body, passed, **mark):
    out = _one_loop_p.bind(*primals, body=body, passed=passed, **mark)
    num_results = len(out) - len(passed)
    active = tuple(i for i, t in enumerate(tangents) if type(t) is not ad.Zero)
    first = len(primals) - body.num_linear
    if active[0] >= first:
        rates = [
            # A scalar will do for one that does not move.
            jnp.zeros((), p.dtype) if type(t) is ad.Zero else t
            for p, t in zip(primals[first:], tangents[first:], strict=True)
        ]
        arguments, tangent = [*primals[:first], *rates], body
        places = {i: i for i in active}
        moving = list(range(num_results))
    else:
        rates = [tangents[i] for i in active]
        arguments, tangent = [*primals, *rates], _tangent(body, active)
        places = {i: len(primals) + k for k, i in enumerate(active)}
        is_moving = _moving_results(body, active)
        moving = [i for i in range(num_results) if is_moving[i]]
    handed_on = [k for k, i in enumerate(passed) if i in places]
    rates_out: list = [ad.Zero(jax.typeof(o).to_tangent_aval()) for o in out]
    if not moving:
        for k in handed_on:
            rates_out[num_results + k] = tangents[passed[k]]
        return out, rates_out
    passed_on = tuple(places[passed[k]] for k in handed_on)
    mark["is_marked"] = True
    moved = _one_loop_p.bind(*arguments, body=tangent, passed=passed_on, **mark)
    # Tangents of a batch's scalars may be scalars still.
    for i, m in zip(moving, moved[: len(moving)], strict=True):
        shape = out[i].shape
        rates_out[i] = m if m.shape == shape else jnp.broadcast_to(m, shape)
    for k, m in zip(handed_on, moved[len(moving) :], strict=True):
        rates_out[num_results + k] = m
    return out, rates_out


ad.primitive_jvps[_one_loop_p] = _jvp


def _transpose(cotangents, *arguments, body, passed, **mark):
    num = len(arguments) - body.num_linear
    others, linear = arguments[:num], arguments[num:]
    num_results = len(body.jaxpr.out_avals)
    present = tuple(
        i for i, ct in enumerate(cotangents[:num_results]) if type(ct) is not ad.Zero
    )
    # What linear arguments that are handed on get back from there.
    back = {
        i - num: ct
        for i, ct in zip(passed, cotangents[num_results:], strict=True)
        if type(ct) is not ad.Zero
    }
    out: list = [None] * len(linear)
    if present:
        shape = common_shape([*others, *(cotangents[i] for i in present)])
        added = tuple(i for i in back if linear[i].aval.shape == shape)
        given = [cotangents[i] for i in present] + [back.pop(i) for i in added]
        transposed = _transposed(body, present, added)
        out = _one_loop_p.bind(*others, *given, body=transposed, passed=(), **mark)
        out = [
            # What went out to a whole batch comes back as a sum.
            jnp.sum(ct)
            if ad.is_undefined_primal(a) and ct.shape != a.aval.shape
            else ct
            for ct, a in zip(out, linear, strict=True)
        ]
    for i, ct in back.items():
        out[i] = ct if out[i] is None else out[i] + ct
    return [None] * num + [
        None
        if not ad.is_undefined_primal(a)
        else (ad.Zero(a.aval) if ct is None else ct)
        for ct, a in zip(out, linear, strict=True)
    ]


ad.primitive_transposes[_one_loop_p] = _transpose


def _on_cpu(context, *arguments, **params):
    rule = by_reduction if is_applied_once() else by_vmap
    return mlir.lower_fun(rule, multiple_results=True)(context, *arguments, **params)


mlir.register_lowering(_one_loop_p, mlir.lower_fun(by_vmap, multiple_results=True))
mlir.register_lowering(_one_loop_p, _on_cpu, platform="cpu")
