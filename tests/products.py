"""Products of matrices in what a function is traced to, and whether they keep all bits.

Searched is all that a function calls, loops, branches, and our own primitives.
"""

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.extend.core
import jax.numpy as jnp

HIGHEST = jax.lax.Precision.HIGHEST


def called(value: Any) -> Iterator[Any]:
    """Functions among the parameters of an operation."""
    if isinstance(value, tuple | list):
        for each in value:
            yield from called(each)
    if isinstance(value, jax.extend.core.Jaxpr):
        yield value
    elif hasattr(value, "jaxpr"):
        yield from called(value.jaxpr)


def operations(jaxpr: Any, searched: dict[int, Any]) -> Iterator[Any]:
    """All that a function does, and every function that it calls, once.

    Rules for derivatives count where a derivative was traced.
    """
    if id(jaxpr) in searched:
        return
    # Held, so that no other gets its number.
    searched[id(jaxpr)] = jaxpr
    for operation in jaxpr.eqns:
        yield operation
        inner = list(operation.params.values())
        if operation.primitive.name == "in_lanes":
            avals = [atom.aval for atom in operation.invars]
            shapes = [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in avals]
            inner.append(jax.make_jaxpr(operation.params["program"])(*shapes))
        for each in called(inner):
            yield from operations(each, searched)


def products(function, *arguments) -> list[tuple[bool, str]]:
    """Whether each product of floats has all bits, and where it is written."""
    jaxpr, *_ = eqx.filter_make_jaxpr(function)(*arguments)
    found = []
    for operation in operations(jaxpr.jaxpr, {}):
        if operation.primitive.name != "dot_general":
            continue
        if jnp.issubdtype(operation.invars[0].aval.dtype, jnp.floating):
            precision = operation.params["precision"]
            is_full = precision is not None and set(precision) == {HIGHEST}
            found.append((is_full, place_of(operation)))
    return found


def place_of(operation) -> str:
    """The line of the package, or of a test, that an operation is from."""
    lines = [
        f"{frame.file_name}:{frame.line_num}"
        for frame in operation.source_info.traceback.frames
    ]
    for name in ("/boomdp_jax/", "/tests/"):
        ours = [line for line in lines if name in line]
        if ours:
            return ours[0]
    return lines[0]


def check(function, *arguments) -> None:
    """There are products, and all of them have all bits."""
    found = products(function, *arguments)
    assert found, "no product"
    assert not [place for is_full, place in found if not is_full]
