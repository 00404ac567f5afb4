r"""Programs over many worlds whose arrays have the batch as their last axis.

`jax.vmap` puts the batch first: the ten bodies of a world then lie side by side, and
whatever picks out some of them, pair by pair, reads and writes single numbers. With
the batch last the same picks are copies of whole rows, and every operation runs along
the rows. A function that is written for arrays `[..., lane]` and called by `in_lanes`
gets that layout from any number of `jax.vmap`s, whose axes become its lanes.

On a CPU lanes are worked on in blocks, so that what a block needs stays in the caches.

Derivatives are functions of the same kind; a reverse pass evaluates the function again,
so one that is long should be checkpointed inside.
"""

import dataclasses
import functools
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import jax
import jax.core
import jax.extend
import jax.numpy as jnp
from jax.interpreters import ad, batching, mlir

BLOCK = 128
"""Lanes of a block on a CPU, unless a caller knows better. Arrays of a round of pairs
are then small enough that the backend leaves each loop to one core: with twice as many
it spreads every one of them over all cores, and the waiting for each other costs more
than the work (16 instead of 8 us of CPU time for a step of ten boxes between four
walls). With half as many, calls of small loops cost a quarter."""

_lanes_p = jax.extend.core.Primitive("in_lanes")
_lanes_p.multiple_results = True


@dataclasses.dataclass(frozen=True)
class _Program:
    """A function of a tree of arrays as one of leaves."""

    function: Callable[..., Any]
    static: tuple[Hashable, ...]
    treedef: Any

    def tree(self, *leaves) -> Any:
        """What the function returns."""
        return self.function(*self.static, *jax.tree.unflatten(self.treedef, leaves))

    def __call__(self, *leaves) -> list:
        return jax.tree.leaves(self.tree(*leaves))


@dataclasses.dataclass(frozen=True)
class _Tangent:
    """From arguments and tangents of the active ones to tangents of the results."""

    program: Any
    num: int
    """Arguments of the program."""
    active: tuple[int, ...]
    floating: tuple[int, ...]
    """Results that have tangents."""

    def _of_active(self, primals: Sequence) -> Callable[..., list]:
        def of_active(*chosen):
            full = list(primals)
            for i, value in zip(self.active, chosen, strict=True):
                full[i] = value
            out = self.program(*full)
            return [out[i] for i in self.floating]

        return of_active

    def __call__(self, *values) -> list:
        primals, rates = values[: self.num], values[self.num :]
        chosen = [primals[i] for i in self.active]
        return jax.jvp(self._of_active(primals), chosen, list(rates))[1]


@dataclasses.dataclass(frozen=True)
class _Transposed:
    """From arguments and cotangents of some results to those of the active ones."""

    tangent: _Tangent
    present: tuple[int, ...]

    def __call__(self, *values) -> list:
        tangent = self.tangent
        primals, given = values[: tangent.num], values[tangent.num :]
        of_active = tangent._of_active(primals)

        def of_present(*chosen):
            out = of_active(*chosen)
            return [out[i] for i in self.present]

        chosen = [primals[i] for i in tangent.active]
        return list(jax.vjp(of_present, *chosen)[1](list(given)))


def in_lanes(
    function: Callable[..., Any],
    *arguments: Any,
    static: tuple[Hashable, ...] = (),
    block: int = BLOCK,
) -> Any:
    """Call a function whose arrays have a last axis over independent lanes.

    Args:
        function: from trees of arrays `[..., lane]` to a tree of such arrays, in which
            no lane depends on another; of any number of lanes. To be defined at module
            level, since what it is compiled to is remembered.
        arguments: trees of arrays without that axis.
        static: what the function takes before its arguments, hashable.
        block: lanes that are worked on together on a CPU. Where the arrays of a lane
            are small, more of them make calls of small loops count for less.

    Returns:
        What the function returns, without the last axis. Batched by `jax.vmap` along
        that axis, and differentiable in both modes.
    """
    leaves, treedef = jax.tree.flatten(arguments)
    leaves = [jnp.asarray(leaf)[..., None] for leaf in leaves]
    program = _Program(function, static, treedef)
    tree_out, _ = _results(program, _shapes_of(leaves), _is_double())
    out = _lanes_p.bind(*leaves, program=program, block=block)
    return jax.tree.unflatten(tree_out, [leaf[..., 0] for leaf in out])


def _is_double() -> bool:
    """Whether floats are double, which decides the type of what a trace writes."""
    return jnp.result_type(float) == jnp.float64


def _shapes_of(arrays) -> tuple:
    """Shapes of one lane, and types."""
    return tuple((array.shape[:-1], array.dtype) for array in arrays)


@functools.lru_cache(maxsize=256)
def _results(program, shapes: tuple, is_double: bool) -> tuple:
    """Tree of the results, and their shapes of one lane, from one trace for all."""
    del is_double  # A part of the key.
    arguments = [jax.ShapeDtypeStruct((*shape, 1), dtype) for shape, dtype in shapes]
    traced = getattr(program, "tree", program)
    out, tree = jax.tree.flatten(jax.eval_shape(traced, *arguments))
    return tree, _shapes_of(out)


@_lanes_p.def_abstract_eval
def _abstract(*avals, program, block):
    del block
    _, out = _results(program, _shapes_of(avals), _is_double())
    lanes = avals[0].shape[-1]
    return [jax.core.ShapedArray((*shape, lanes), dtype) for shape, dtype in out]


@functools.lru_cache(maxsize=256)
def _compiled(program, block):
    def run(*arguments):
        if any(isinstance(a, jax.core.Tracer) for a in arguments):
            return _lanes_p.bind(*arguments, program=program, block=block)
        # Compilation is switched off.
        return program(*arguments)

    return jax.jit(run)


@_lanes_p.def_impl
def _run(*arguments, program, block):
    return _compiled(program, block)(*arguments)


def _batched(arguments: Sequence, dims: Sequence, *, program, block):
    size = next(
        a.shape[d] for a, d in zip(arguments, dims, strict=True) if d is not None
    )
    lanes = next(
        a.shape[-1] if d is None or d % a.ndim != a.ndim - 1 else a.shape[-2]
        for a, d in zip(arguments, dims, strict=True)
    )

    def merged(array, dim):
        if dim is None:
            array = jnp.broadcast_to(array[..., None], (*array.shape, size))
        else:
            array = jnp.moveaxis(array, dim, -1)
        return array.reshape(*array.shape[:-2], lanes * size)

    out = _lanes_p.bind(
        *(merged(a, d) for a, d in zip(arguments, dims, strict=True)),
        program=program,
        block=block,
    )
    out = [leaf.reshape(*leaf.shape[:-1], lanes, size) for leaf in out]
    return out, [leaf.ndim - 1 for leaf in out]


batching.primitive_batchers[_lanes_p] = _batched


def _jvp(primals, tangents, *, program, block):
    out = _lanes_p.bind(*primals, program=program, block=block)
    active = tuple(i for i, t in enumerate(tangents) if type(t) is not ad.Zero)
    floating = tuple(
        i for i, o in enumerate(out) if jnp.issubdtype(o.dtype, jnp.inexact)
    )
    tangent = _Tangent(program, len(primals), active, floating)
    rates = (tangents[i] for i in active)
    moved = _lanes_p.bind(*primals, *rates, program=tangent, block=block)
    rates = [ad.Zero(jax.typeof(o).to_tangent_aval()) for o in out]
    for i, rate in zip(floating, moved, strict=True):
        rates[i] = rate
    return out, rates


ad.primitive_jvps[_lanes_p] = _jvp


def _transpose(cotangents, *arguments, program, block):
    primals = arguments[: program.num]
    present = tuple(i for i, ct in enumerate(cotangents) if type(ct) is not ad.Zero)
    if not present:
        return [
            ad.Zero(a.aval) if ad.is_undefined_primal(a) else None for a in arguments
        ]
    given = [cotangents[i] for i in present]
    transposed = _Transposed(program, present)
    out = _lanes_p.bind(*primals, *given, program=transposed, block=block)
    return [None] * program.num + list(out)


ad.primitive_transposes[_lanes_p] = _transpose


def _in_blocks(*arguments, program, block):
    """Block after block, each of the same length."""
    lanes = arguments[0].shape[-1]
    num = -(-lanes // block)
    if num <= 1:
        return program(*arguments)
    length = -(-lanes // num)
    spare = num * length - lanes

    def in_parts(array):
        if spare:
            rest = jnp.broadcast_to(array[..., -1:], (*array.shape[:-1], spare))
            array = jnp.concatenate([array, rest], axis=-1)
        return jnp.moveaxis(array.reshape(*array.shape[:-1], num, length), -2, 0)

    out = jax.lax.map(lambda part: program(*part), [in_parts(a) for a in arguments])
    merged = [jnp.moveaxis(leaf, 0, -2) for leaf in out]
    return [
        leaf.reshape(*leaf.shape[:-2], num * length)[..., :lanes] for leaf in merged
    ]


def _at_once(*arguments, program, block):
    del block
    return program(*arguments)


mlir.register_lowering(_lanes_p, mlir.lower_fun(_at_once, multiple_results=True))
mlir.register_lowering(
    _lanes_p, mlir.lower_fun(_in_blocks, multiple_results=True), platform="cpu"
)
