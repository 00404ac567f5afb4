"""Functions of small arrays, written out number by number.

`one_loop` makes one loop over the batch of a function of scalars. What is worked out
once for each hypothesis is written in arrays, of six feet or of two anchors, and has a
hundred operations: a hundred loops over the batch, each of which the compiler writes,
and starts, on its own. Here the arrays of such a function are taken apart: its
operations are gone through with an object array of scalars in place of each array.
What only moves numbers (slices, stacks, transposes) then costs nothing at all.
"""

import functools
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple

import jax
import jax.core
import jax.extend
import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.one_loop import one_loop

_ELEMENTWISE = frozenset(
    """
    abs add and atan2 cbrt ceil clamp convert_element_type copy copy_p cos cosh div eq
    erf erf_inv exp exp2 expm1 floor ge gt integer_pow is_finite le lgamma log log1p
    logistic lt max min mul ne neg not or pow reduce_precision rem round rsqrt select_n
    sign sin sinh sqrt square stop_gradient sub tan tanh xor
    """.split()
)
"""Primitives that work number by number."""
_MOVES = frozenset(
    """
    broadcast_in_dim concatenate expand_dims reshape rev slice split squeeze stack tile
    transpose unstack
    """.split()
)
"""Primitives that only say where numbers go."""
_FOLDED = {
    "reduce_sum": (jax.lax.add, 0),
    "reduce_max": (jax.lax.max, -np.inf),
    "reduce_min": (jax.lax.min, np.inf),
    "reduce_and": (jax.lax.bitwise_and, True),
    "reduce_or": (jax.lax.bitwise_or, False),
}
"""Reductions: what they do with two numbers, and what they make of none."""


def one_loop_of_arrays(
    function: Callable[..., Any], *arguments: Any, static: tuple[Hashable, ...] = ()
) -> Any:
    """Apply a function of small arrays, as one loop wherever it is batched.

    Args:
        function: from trees of arrays, floating of one type or truth values, to such a
            tree, by arithmetic, reductions, and what moves numbers to places known
            beforehand. To be defined at module level, since it is remembered.
        arguments: trees of arrays; one of them at least is floating.
        static: what the function takes before its arguments, hashable.

    Returns:
        What the function returns. Batched by `jax.vmap` and differentiable in both
        modes; derivatives are those of the operations, also where the function calls
        one that has rules of its own.

    Raises:
        TypeError: if arrays are of other types, or the function does what cannot be
            written out.
    """
    leaves, treedef = jax.tree.flatten(arguments)
    leaves = [jnp.asarray(leaf) for leaf in leaves]
    kinds = [leaf.dtype for leaf in leaves if leaf.dtype != jnp.bool_]
    if not kinds:
        raise TypeError("one_loop_of_arrays needs a floating array, got none")
    dtype = jnp.result_type(*kinds)
    shapes = tuple((leaf.shape, leaf.dtype == jnp.bool_) for leaf in leaves)
    is_double = jnp.result_type(float) == jnp.float64
    whole = _Whole(function, static, treedef, shapes, np.dtype(dtype), is_double)
    jaxpr, tree_out = _jaxpr(whole)
    numbers = [
        number
        for leaf in leaves
        for number in _numbers(leaf.astype(dtype) if leaf.size else leaf)
    ]
    out = one_loop(_written_out, numbers, static=(whole,))
    arrays, first = [], 0
    for aval in jaxpr.out_avals:
        parts = out[first : first + aval.size]
        first += aval.size
        array = jnp.array(parts, dtype).reshape(aval.shape) if aval.shape else parts[0]
        arrays.append(array != 0 if aval.dtype == jnp.bool_ else array)
    return jax.tree.unflatten(tree_out, arrays)


def _numbers(leaf) -> list:
    """An array's numbers, one by one."""
    return [leaf[index] for index in np.ndindex(leaf.shape)]


class _Whole(NamedTuple):
    """A function, and what it is called with."""

    function: Callable[..., Any]
    static: tuple[Hashable, ...]
    treedef: Any
    shapes: tuple[tuple[tuple[int, ...], bool], ...]
    """Of each array, and whether it is of truth values."""
    dtype: np.dtype
    is_double: bool
    """Decides the type of indices."""


@functools.lru_cache(maxsize=256)
def _jaxpr(whole: _Whole) -> tuple[Any, Any]:
    """What it does, and the tree of its results."""
    dtype = whole.dtype
    arguments = [
        jax.ShapeDtypeStruct(shape, jnp.bool_ if is_truth else dtype)
        for shape, is_truth in whole.shapes
    ]
    tree_out = []

    def flat(*leaves):
        out = whole.function(*whole.static, *jax.tree.unflatten(whole.treedef, leaves))
        out, tree = jax.tree.flatten(out)
        tree_out[:] = [tree]
        return [jnp.asarray(leaf) for leaf in out]

    jaxpr = jax.make_jaxpr(flat)(*arguments)
    for aval in jaxpr.out_avals:
        if aval.dtype not in (dtype, jnp.bool_):
            raise TypeError(
                f"a function for one_loop_of_arrays returns arrays of type {dtype} or "
                f"truth values, got {aval.dtype}"
            )
    return jaxpr, tree_out[0]


def _written_out(whole: _Whole, numbers: Sequence) -> list:
    """All results of a function, number by number."""
    arrays, first = [], 0
    for shape, is_truth in whole.shapes:
        num = int(np.prod(shape))
        chosen = numbers[first : first + num]
        first += num
        arrays.append(_array([n != 0 if is_truth else n for n in chosen], shape))
    jaxpr, _ = _jaxpr(whole)
    out = _evaluated(jaxpr, arrays)
    flat = [number for array in out for number in array.reshape(-1)]
    return [jnp.asarray(number, whole.dtype) for number in flat]


def _array(numbers: Sequence, shape: tuple[int, ...]) -> np.ndarray:
    """An object array of numbers."""
    array = np.empty(len(numbers), object)
    for index, number in enumerate(numbers):
        # One by one: NumPy would ask a traced number for its value.
        array[index] = number
    return array.reshape(shape)


def _constant(value) -> np.ndarray:
    value = np.asarray(value)
    return _array([number[()] for number in value.reshape(-1)], value.shape)


def _evaluated(jaxpr, arrays: Sequence[np.ndarray]) -> list[np.ndarray]:
    """What a closed function of arrays yields, in object arrays."""
    known = dict(zip(jaxpr.jaxpr.invars, arrays, strict=True))
    for var, const in zip(jaxpr.jaxpr.constvars, jaxpr.consts, strict=True):
        if isinstance(const, jax.core.Tracer):
            raise TypeError(
                "a function for one_loop_of_arrays takes what it depends on as "
                f"arguments, got a traced value from outside: {const}"
            )
        known[var] = _constant(const)

    def read(atom) -> np.ndarray:
        is_variable = isinstance(atom, jax.extend.core.Var)
        return known[atom] if is_variable else _constant(atom.val)

    for eqn in jaxpr.jaxpr.eqns:
        taken = [read(atom) for atom in eqn.invars]
        called = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
        if called is not None:
            out = _evaluated(called, taken)
        else:
            out = _results(eqn, taken)
        known |= dict(zip(eqn.outvars, out, strict=True))
    return [read(atom) for atom in jaxpr.jaxpr.outvars]


def _results(eqn, taken: list[np.ndarray]) -> list[np.ndarray]:
    """What one operation yields."""
    name, params = eqn.primitive.name, eqn.params
    if name in _ELEMENTWISE:
        shape = eqn.outvars[0].aval.shape
        spread = [np.broadcast_to(array, shape).reshape(-1) for array in taken]
        found = [_bound(eqn, row) for row in zip(*spread, strict=True)]
        return [_array(found, shape)]
    if name in _FOLDED:
        function, none = _FOLDED[name]
        none = eqn.outvars[0].aval.dtype.type(none)
        return [_folded(function, none, taken[0], params["axes"])]
    if name in _MOVES:
        return _moved(eqn, taken)
    if name == "iota":
        with jax.ensure_compile_time_eval():
            return [_constant(eqn.primitive.bind(**params))]
    raise TypeError(
        "a function for one_loop_of_arrays does nothing but arithmetic, reductions and "
        f"moves to known places, got {name}"
    )


def _bound(eqn, numbers: tuple):
    """One operation on numbers."""
    return eqn.primitive.bind(*numbers, **eqn.params)


def _moved(eqn, taken: list[np.ndarray]) -> list[np.ndarray]:
    """The same numbers at other places: the operation itself says where each goes."""
    numbers = [number for array in taken for number in array.reshape(-1)]
    places, first = [], 0
    for array in taken:
        places.append(np.arange(first, first + array.size, dtype=np.int32))
        places[-1] = places[-1].reshape(array.shape)
        first += array.size
    with jax.ensure_compile_time_eval():
        out = eqn.primitive.bind(*map(jnp.asarray, places), **eqn.params)
    out = out if eqn.primitive.multiple_results else [out]
    return [
        _array([numbers[i] for i in np.asarray(place).reshape(-1)], place.shape)
        for place in out
    ]


def _folded(
    function: Callable, none: np.generic, array: np.ndarray, axes: Sequence[int]
) -> np.ndarray:
    """A reduction, the numbers taken one after the other."""
    kept = [axis for axis in range(array.ndim) if axis not in axes]
    moved = np.transpose(array, (*kept, *axes))
    shape, depth = moved.shape[: len(kept)], moved.shape[len(kept) :]
    rows = moved.reshape(int(np.prod(shape)), int(np.prod(depth)))
    found = [functools.reduce(function, row) if len(row) else none for row in rows]
    return _array(found, shape)
