"""Calls of one compiled program, several at a time.

XLA's CPU backend spreads each small loop of a program over all cores and waits for
them, which costs more than it saves unless a loop is long. Independent calls on
threads of their own share nothing and wait for nothing: on two cores they take 0.4
times as long as one after the other.
"""

import concurrent.futures
import functools
import os
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from boomdp_jax.core.thread_precision import in_this_precision

# What has been called before, and is therefore compiled.
_compiled: set[object] = set()


def num_threads() -> int:
    """How many calls are made at a time: one for each core of this process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@functools.cache
def _pool() -> concurrent.futures.ThreadPoolExecutor:
    return concurrent.futures.ThreadPoolExecutor(num_threads())


def forget_compiled() -> None:
    """Forget what is compiled, as after `jax.clear_caches`."""
    _compiled.clear()


def call_each(
    function: Callable[..., Any], inputs: Sequence[tuple], like: Any
) -> list[Any]:
    """Call a function once with each tuple of arguments, on several threads.

    Args:
        function: calls a compiled program and waits for its result. It must not itself
            use this.
        inputs: arguments of each call, of the same shapes.
        like: tree of arrays on whose static parts, shapes and types the program
            depends. The first call for it is made alone, so that threads do not compile
            the same thing at once.

    Returns:
        The results, in order.
    """
    leaves, treedef = jax.tree.flatten(like)
    shapes = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
    key = (function, treedef, shapes, jnp.zeros(()).dtype)
    of_arguments = in_this_precision(function)

    def call(arguments: tuple) -> Any:
        return of_arguments(*arguments)

    results = []
    if key not in _compiled and inputs:
        results.append(call(inputs[0]))
        _compiled.add(key)
    rest = inputs[len(results) :]
    if len(rest) < 2:
        return results + [call(arguments) for arguments in rest]
    return results + list(_pool().map(call, rest))
