"""Solutions that are searched for, with the derivative of one further step.

At a solution one more step of Newton's method changes nothing, and its derivative with
what it starts from held constant is that of the solution: the implicit function
theorem. (A step from a little beside the solution leads to the solution all the same,
so second derivatives, for which the solution moves, are right as well, if the step
starts from the solution.) The step is only taken where there is a derivative to be
worked out; what wants none compiles, and runs, without it.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
from jax.custom_derivatives import SymbolicZero, zero_from_primal


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def searched(
    search: Callable[[Any, Any], tuple[Any, Any]],
    step: Callable[[Any, Any, Any], Any],
    problem: Any,
    given: Any,
) -> tuple[Any, Any]:
    """Search for a solution.

    Args:
        search: from problem and what is given to the solution, a tree of floating
            arrays, and to what else there is to know of it. It and the step take all
            that they depend on as arguments.
        step: from problem, solution and the rest to a solution of the same form.
        problem: tree of arrays that the solution depends on.
        given: tree of arrays that only the search depends on.

    Returns:
        What the search does. The derivative of the solution by the problem is that of
        the step, in both modes; by what is given there is none, and of the rest none.
    """
    del step
    return search(problem, given)


def _rate(search, step, primals, tangents):
    problem, given = primals
    found, rest = searched(search, step, problem, given)
    leaves, treedef = jax.tree.flatten(problem)
    rates = jax.tree.leaves(tangents[0], is_leaf=_is_zero)
    moving = [i for i, rate in enumerate(rates) if not _is_zero(rate)]

    def of_moving(*chosen):
        full = list(leaves)
        for i, leaf in zip(moving, chosen, strict=True):
            full[i] = leaf
        return step(jax.tree.unflatten(treedef, full), found, rest)

    rate = zero_from_primal(found)
    if moving:
        at = tuple(leaves[i] for i in moving)
        rate = jax.jvp(of_moving, at, tuple(rates[i] for i in moving))[1]
    return (found, rest), (rate, zero_from_primal(rest))


def _is_zero(rate: Any) -> bool:
    return isinstance(rate, SymbolicZero)


searched.defjvp(_rate, symbolic_zeros=True)
