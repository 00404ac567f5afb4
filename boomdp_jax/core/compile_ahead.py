"""Compile what comes later while fits go on, on a thread of its own.

Compilation holds one core and not Python's lock. Each program is called once on numbers
that mean nothing, which leaves it in JAX's cache; nothing else comes of it.
"""

import concurrent.futures
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from boomdp_jax.core.thread_precision import in_this_precision

# Signatures of the targets for which it has been done in this process.
_done: set[object] = set()


def signature(tree: Any) -> object:
    """Static parts and array shapes: what a compiled program depends on."""
    arrays, static = eqx.partition(tree, eqx.is_array)
    leaves, treedef = jax.tree.flatten(arrays)
    shapes = tuple((leaf.shape, str(leaf.dtype)) for leaf in leaves)
    return shapes, treedef, str(jax.tree.structure(static))


class CompileAhead:
    """Runs a function on another thread while entered, once per signature.

    What it raises is dropped: the same call in earnest will raise it again.
    """

    def __init__(self, work: Callable[[], object], key: object):
        self._work = None if key in _done else work
        _done.add(key)
        self._pool: concurrent.futures.ThreadPoolExecutor | None = None

    def __enter__(self) -> "CompileAhead":
        work = self._work
        if work is not None:
            self._pool = concurrent.futures.ThreadPoolExecutor(1)
            self._pool.submit(in_this_precision(work))
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
