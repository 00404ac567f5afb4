"""Which results of a traced function have a derivative by some of its arguments."""

from collections.abc import Sequence
from typing import Any

import jax.extend
import jax.numpy as jnp


def depends_on(jaxpr: Any, is_active: Sequence[bool]) -> tuple[bool, ...]:
    """Follow derivatives from arguments to results.

    Args:
        jaxpr: the function, open.
        is_active: for each argument whether it changes.

    Returns:
        For each result whether it may change with them to first order: not what is
        reached through integers and truth values alone, or behind `stop_gradient`.
    """
    moving = {var for var, on in zip(jaxpr.invars, is_active, strict=True) if on}

    def is_moving(atom: Any) -> bool:
        return isinstance(atom, jax.extend.core.Var) and atom in moving

    for eqn in jaxpr.eqns:
        taken = [is_moving(atom) for atom in eqn.invars]
        if eqn.primitive.name == "stop_gradient" or not any(taken):
            continue
        called = eqn.params.get("jaxpr")
        if isinstance(called, jax.extend.core.ClosedJaxpr):
            made = depends_on(called.jaxpr, taken)
        else:
            made = [jnp.issubdtype(v.aval.dtype, jnp.floating) for v in eqn.outvars]
        moving.update(var for var, on in zip(eqn.outvars, made, strict=True) if on)
    return tuple(is_moving(atom) for atom in jaxpr.outvars)
