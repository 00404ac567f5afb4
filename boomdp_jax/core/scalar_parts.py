"""Cut a long function of scalars into parts that a compiler can take whole."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.extend.core import Var

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
    dtypes = [aval.dtype for aval in jaxpr.in_avals]
    num_arguments, operations = len(dtypes), []
    outcome = _opened(jaxpr, range(num_arguments), dtypes, operations, {})
    operations = _needed(operations, outcome)
    num_parts = 1
    if len(operations) > most_whole:
        num_parts = -(-len(operations) // most)
    last_use = {
        v: i for i, each in enumerate(operations) for v in each.taken if type(v) is int
    }
    last_use |= {v: len(operations) for v in outcome if type(v) is int}
    cuts = _cuts(operations, last_use, dtypes, num_parts)
    numbers = {i: i for i in range(num_arguments)}
    parts = []
    for first, last in itertools.pairwise(cuts):
        inside = operations[first:last]
        # Ordered, as a dictionary is.
        made = dict.fromkeys(v for each in inside for v in each.made)
        used = [v for each in inside for v in each.taken if type(v) is int]
        results: list = [v for v in made if last_use.get(v, -1) >= last]
        if last == len(operations):
            results = outcome
            used += [v for v in results if type(v) is int]
        taken = {v: dtypes[v] for v in dict.fromkeys(used) if v not in made}
        # Where nothing is taken any value will do, to tell the type.
        inputs = tuple(numbers[v] for v in taken) or (0,)
        parts.append(Part(_function(inside, taken, results), inputs, len(results)))
        if last < len(operations):
            numbers |= {v: len(numbers) + i for i, v in enumerate(results)}
    return parts


class _Operation(NamedTuple):
    """One of a function's, with those that it calls opened up.

    There are thousands, which is why what is done to each is written out where it is
    done.
    """

    primitive: Any
    params: dict
    taken: list
    """Values by number, or constants in a form that is written into the code."""
    made: list[int]


def _opened(
    jaxpr: Any, values: Sequence, dtypes: list, operations: list, done: dict
) -> list:
    """Add a closed function's operations to those before it.

    Args:
        jaxpr: the function.
        values: its arguments, by number, or constants.
        dtypes: of the values so far; added to.
        operations: so far; added to.
        done: results of operations that need not be done again; added to.

    Returns:
        Its results, as `values`.
    """
    known = dict(zip(jaxpr.jaxpr.invars, values, strict=True))
    known |= dict(zip(jaxpr.jaxpr.constvars, map(_number, jaxpr.consts), strict=True))
    for eqn in jaxpr.jaxpr.eqns:
        taken = [
            known[atom] if isinstance(atom, Var) else _number(atom.val)
            for atom in eqn.invars
        ]
        called = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
        if called is not None:
            out = _opened(called, taken, dtypes, operations, done)
        else:
            names = [v if type(v) is int else (repr(v), v.dtype) for v in taken]
            key = (eqn.primitive, repr(eqn.params), *names)
            if key not in done:
                done[key] = [len(dtypes) + i for i in range(len(eqn.outvars))]
                dtypes += [var.aval.dtype for var in eqn.outvars]
                each = _Operation(eqn.primitive, eqn.params, taken, done[key])
                operations.append(each)
            out = done[key]
        known |= dict(zip(eqn.outvars, out, strict=True))
    return [
        known[atom] if isinstance(atom, Var) else _number(atom.val)
        for atom in jaxpr.jaxpr.outvars
    ]


def _number(const):
    """A constant in a form that is written into the code."""
    return np.asarray(const)[()]


def _needed(operations: list, outcome: list) -> list:
    """The operations that results depend on."""
    wanted, kept = {v for v in outcome if type(v) is int}, []
    for each in reversed(operations):
        if wanted.intersection(each.made):
            kept.append(each)
            wanted.update(v for v in each.taken if type(v) is int)
    return kept[::-1]


def _cuts(operations: list, last_use: dict, dtypes: list, num_parts: int) -> list[int]:
    """Where parts begin and end: near equal lengths, where little is alive."""
    num, cuts = len(operations), [0]
    if num_parts == 1:
        return [0, num]
    change = np.zeros(num + 2)
    for i, each in enumerate(operations):
        for value in each.made:
            is_integer = jnp.issubdtype(dtypes[value], jnp.integer)
            cost = _INTEGER_COST if is_integer else 1.0
            # Alive at the borders after it, up to its last use.
            change[i + 1] += cost
            change[last_use.get(value, i) + 1] -= cost
    alive = np.cumsum(change)
    slack = int(_SLACK * num / num_parts)
    for k in range(1, num_parts):
        middle = k * num // num_parts
        first = max(middle - slack, cuts[-1] + 1)
        cuts.append(first + int(np.argmin(alive[first : middle + slack + 1])))
    return [*cuts, num]


def _function(operations: list, taken: dict, results: list) -> Callable[..., list]:
    """Those operations, from floating scalars to floating scalars."""

    def function(*values):
        dtype = values[0].dtype
        known = {}
        for (v, kind), value in zip(taken.items(), values, strict=False):
            known[v] = value != 0 if kind == jnp.bool_ else jnp.asarray(value, kind)
        for each in operations:
            given = [known[v] if type(v) is int else v for v in each.taken]
            out = each.primitive.bind(*given, **each.params)
            out = out if each.primitive.multiple_results else [out]
            known |= dict(zip(each.made, out, strict=True))
        return [jnp.asarray(known[v] if type(v) is int else v, dtype) for v in results]

    return function
