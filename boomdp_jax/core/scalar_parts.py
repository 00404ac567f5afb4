"""Cut a long function of scalars into parts that a compiler can take whole."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.core
import jax.extend
import jax.numpy as jnp
import numpy as np

_MOST_WHOLE = 2100
"""A function of at most so many operations stays whole.

XLA's CPU backend writes a loop body of at most 2000 operations, of which it counts a
few fewer than there are here, as one function. Of what is used on both sides of that
border it makes functions that it computes again for every use: 9000 operations then
take forty seconds to compile instead of two, and each takes two hundred times longer
to run. A hundred too many do no harm, while a border of our own, where some
hundred values are alive, made a reverse pass five times slower."""
_MOST_OPERATIONS = 1200
"""Aimed at in each part of a longer one."""
_SLACK = 0.2
"""How far a cut may be moved to where little is alive, in lengths of a part."""
_INTEGER_COST = 1000.0
"""Against cuts where an integer is alive, which a floating number may not hold."""


class Part(NamedTuple):
    """Some consecutive operations; values go by number, the arguments' first."""

    function: Callable[..., list]
    """From floating scalars to a list of floating scalars."""
    inputs: tuple[int, ...]
    """Which values it takes."""
    num_outputs: int
    """It yields the next so many values; those of the last part are the results."""


def parts_of(
    jaxpr: Any, most_whole: int = _MOST_WHOLE, most: int = _MOST_OPERATIONS
) -> list[Part]:
    """Cut a function of scalars.

    Args:
        jaxpr: the function, closed: arithmetic alone, with floating arguments of one
            type.
        most_whole: of this many operations it stays one part.
        most: operations in each part of a longer one, give or take what `_SLACK` says.

    Returns:
        The parts, one after the other. Truth values go from one to the next as zero
        and one.
    """
    shapes = [jax.ShapeDtypeStruct((), aval.dtype) for aval in jaxpr.in_avals]
    flat = jax.make_jaxpr(lambda *values: _evaluated(jaxpr, values, {}))(*shapes).jaxpr
    equations = _needed(flat)
    num_parts = 1
    if len(equations) > most_whole:
        num_parts = -(-len(equations) // most)
    last_use = {
        var: i for i, eqn in enumerate(equations) for var in _variables(eqn.invars)
    }
    last_use |= dict.fromkeys(_variables(flat.outvars), len(equations))
    cuts = _cuts(equations, last_use, num_parts)
    numbers = {var: i for i, var in enumerate(flat.invars)}
    parts = []
    for first, last in itertools.pairwise(cuts):
        inside = equations[first:last]
        # Ordered, as a dictionary is.
        made = dict.fromkeys(var for eqn in inside for var in eqn.outvars)
        used = [var for eqn in inside for var in _variables(eqn.invars)]
        results = [var for var in made if last_use.get(var, -1) >= last]
        if last == len(equations):
            results = list(flat.outvars)
            used += _variables(results)
        taken = [var for var in dict.fromkeys(used) if var not in made]
        # Where nothing is taken any value will do, to tell the type.
        inputs = tuple(numbers[var] for var in taken) or (0,)
        parts.append(Part(_function(inside, taken, results), inputs, len(results)))
        if last < len(equations):
            numbers |= {var: len(numbers) + i for i, var in enumerate(results)}
    return parts


def _is_variable(atom) -> bool:
    return isinstance(atom, jax.extend.core.Var)


def _variables(atoms) -> list:
    return [atom for atom in atoms if _is_variable(atom)]


def _evaluated(jaxpr, values, done: dict) -> list:
    """What a closed function yields, with the functions that it calls opened up.

    Args:
        jaxpr: the function.
        values: its arguments.
        done: operations that need not be done again, and their results.

    Returns:
        Its results.
    """
    known = dict(zip(jaxpr.jaxpr.invars, values, strict=True))
    known |= dict(zip(jaxpr.jaxpr.constvars, map(_number, jaxpr.consts), strict=True))
    for eqn in jaxpr.jaxpr.eqns:
        taken = [_read(atom, known) for atom in eqn.invars]
        called = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
        if called is not None:
            out = _evaluated(called, taken, done)
        else:
            names = [
                id(v) if isinstance(v, jax.core.Tracer) else (repr(v), v.dtype)
                for v in taken
            ]
            key = (eqn.primitive, repr(eqn.params), *names)
            if key not in done:
                # The values stay with it: a name is unique among what is alive.
                done[key] = taken, _applied(eqn, taken)
            out = done[key][1]
        known |= dict(zip(eqn.outvars, out, strict=True))
    return [_read(atom, known) for atom in jaxpr.jaxpr.outvars]


def _number(const):
    """A constant in a form that is written into the code."""
    return np.asarray(const)[()]


def _read(atom, known):
    return known[atom] if _is_variable(atom) else _number(atom.val)


def _applied(eqn, values) -> list:
    out = eqn.primitive.bind(*values, **eqn.params)
    return list(out) if eqn.primitive.multiple_results else [out]


def _needed(flat) -> list:
    """The operations that results depend on."""
    wanted, kept = set(_variables(flat.outvars)), []
    for eqn in reversed(flat.eqns):
        if wanted.intersection(eqn.outvars):
            kept.append(eqn)
            wanted.update(_variables(eqn.invars))
    return kept[::-1]


def _cuts(equations: list, last_use: dict, num_parts: int) -> list[int]:
    """Where parts begin and end: near equal lengths, where little is alive."""
    num = len(equations)
    change = np.zeros(num + 2)
    for i, eqn in enumerate(equations):
        for var in eqn.outvars:
            is_integer = jnp.issubdtype(var.aval.dtype, jnp.integer)
            cost = _INTEGER_COST if is_integer else 1.0
            # Alive at the borders after it, up to its last use.
            change[i + 1] += cost
            change[last_use.get(var, i) + 1] -= cost
    alive = np.cumsum(change)
    slack = int(_SLACK * num / num_parts)
    cuts = [0]
    for k in range(1, num_parts):
        middle = k * num // num_parts
        first = max(middle - slack, cuts[-1] + 1)
        cuts.append(first + int(np.argmin(alive[first : middle + slack + 1])))
    return [*cuts, num]


def _function(equations: list, taken: list, results: Sequence) -> Callable[..., list]:
    """Those operations, from floating scalars to floating scalars."""

    def function(*values):
        dtype = values[0].dtype
        known = {}
        for var, value in zip(taken, values, strict=False):
            is_truth = var.aval.dtype == jnp.bool_
            known[var] = value != 0 if is_truth else jnp.asarray(value, var.aval.dtype)
        for eqn in equations:
            out = _applied(eqn, [_read(atom, known) for atom in eqn.invars])
            known |= dict(zip(eqn.outvars, out, strict=True))
        return [jnp.asarray(_read(atom, known), dtype) for atom in results]

    return function
