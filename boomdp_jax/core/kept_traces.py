"""What JAX traced and lowered in one process, kept on disk for the next.

JAX keeps compiled programs (`kept_programs`), but finds them by the program itself,
which it has to trace and lower first: nine seconds for a filter of one body, of thirty
that an inference then takes. What a function of this library becomes depends on its
source, on the shapes and types of arguments, on static fields, versions and settings
alone. A file that is named after all these holds the lowered function (`jax.export`),
so that the next process has it in a tenth of a second.

Functions that were put in place of others while a program ran (as tests do) show in
none of these: who does that should not keep traces.
"""

import contextlib
import functools
import hashlib
import importlib.metadata
import importlib.util
import inspect
import json
import pathlib
import platform
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jax.core import Tracer
from jax.extend.core import Primitive
from jax.interpreters import mlir

from boomdp_jax.core.atomic import atomic_write
from boomdp_jax.core.loop_code import is_applied_once
from boomdp_jax.core.tree_text import (
    UnwritableError,
    is_ours,
    static_text,
    tree_of_text,
    tree_text,
)

TRACE_FILES = f"*-{'[0-9a-f]' * 64}.trace"
"""Pattern of their names."""

# What a trace may depend on besides this library, by distribution.
_LIBRARIES = ("jax", "jaxlib", "numpy", "equinox", "jaxtyping", "numpyro")
_PACKAGE = pathlib.Path(__file__).parents[1]
_BEGUN = time.time()

_folder: pathlib.Path | None = None


def keep_traces(folder: pathlib.Path | None) -> None:
    """Keep traces from now on, where JAX can write them.

    Args:
        folder: where; it must exist. None: no longer.
    """
    global _folder
    is_writable = importlib.util.find_spec("flatbuffers") is not None
    _folder = folder.absolute() if folder is not None and is_writable else None


def are_traces_kept() -> bool:
    """Whether they are in this process: on CPUs, where devices are all alike."""
    return _folder is not None and jax.default_backend() == "cpu"


class _Kept(NamedTuple):
    """A function of leaves."""

    exported: Any
    outcome: str
    """Description of the tree that it returns."""
    is_weak: tuple[bool, ...]
    """Whether the type of each leaf of it gives way to that of others."""


def kept_trace(
    function: Callable[..., Any], static: Sequence[str] = ()
) -> Callable[..., Any]:
    """Let a function, when `jax.jit` traces it, be taken from disk.

    What comes from disk cannot be differentiated, nor mapped.

    Args:
        function: of trees of arrays. One that a module of this library has by its name
            is kept, also with some plain arguments given (`functools.partial`); others,
            which may hold anything, are traced as ever, and so is what is given or
            returns other trees than `tree_text` describes.
        static: names of arguments that are not, hashable.

    Returns:
        The function.
    """

    @functools.wraps(function)
    def traced(*arguments: Any, **named: Any) -> Any:
        given, fixed = (arguments, named), {}
        if static:
            every = inspect.signature(function).bind(*arguments, **named).arguments
            fixed = {name: every.pop(name) for name in static if name in every}
            given = (), every
        leaves, structure = jax.tree.flatten(given)
        if not any(isinstance(leaf, Tracer) for leaf in leaves):
            # With `jax.disable_jit` nothing is traced.
            return function(*arguments, **named)
        types = [jax.typeof(leaf) for leaf in leaves]
        kept = _kept(function, fixed, structure, types)
        if kept is None:
            return function(*arguments, **named)
        found = _call_kept.bind(*leaves, kept=kept)
        outcome = jax.tree.structure(tree_of_text(kept.outcome))
        return jax.tree.unflatten(outcome, found)

    return traced


# Not by `exported.call` itself, whose results JAX takes to be committed to a device:
# what is called with them is then compiled once more.
_call_kept = Primitive("call_kept")
_call_kept.multiple_results = True


@_call_kept.def_abstract_eval
def _types_of_results(*_: Any, kept: _Kept) -> list[Any]:
    pairs = zip(kept.exported.out_avals, kept.is_weak, strict=True)
    return [aval.update(weak_type=is_weak) for aval, is_weak in pairs]


def _lower(context: Any, *arguments: Any, kept: _Kept) -> Any:
    call = mlir.lower_fun(kept.exported.call, multiple_results=True)
    return call(context, *arguments)


mlir.register_lowering(_call_kept, _lower)


def _kept(function, static: dict[str, Any], structure, types: list) -> _Kept | None:
    """The function, from disk or put there; None if it cannot be kept."""
    folder = _folder
    if folder is None:
        return None
    try:
        name, *texts = _name_of(function)
        tree = jax.tree.unflatten(structure, types)
        texts += [tree_text(tree), static_text(sorted(static.items()))]
        known = [name, *texts, *map(str, types), *_circumstances()]
        source = _source()
    except Exception:
        # Settings of JAX may forbid what is tried out, a source may be gone.
        return None
    if source is None:
        return None
    known.append(source)
    digest = hashlib.sha256(json.dumps(known).encode()).hexdigest()
    path = folder / f"{name.rpartition(':')[2]}-{digest}.trace"
    read = _read(path)
    if read is not None:
        return read
    outcome, is_weak = "", ()

    def of_leaves(*leaves):
        nonlocal outcome, is_weak
        ordered, given = jax.tree.unflatten(structure, leaves)
        found = function(*ordered, **given, **static)
        outcome = tree_text(found)
        leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves(found)]
        is_weak = tuple(bool(jax.typeof(leaf).weak_type) for leaf in leaves)
        return leaves

    try:
        exported = export.export(jax.jit(of_leaves))(*types)
    except Exception:
        # It may not be of a kind that can be kept. If it is wrong, then tracing it as
        # ever says so.
        return None
    made = _Kept(exported, outcome, is_weak)
    _write(path, made)
    return made


def _read(path: pathlib.Path) -> _Kept | None:
    """What is in a file, if it is there and whole."""
    try:
        first, _, content = path.read_bytes().partition(b"\n")
        outcome, is_weak = json.loads(first)
        kept = _Kept(export.deserialize(bytearray(content)), outcome, tuple(is_weak))
        num = len(jax.tree.leaves(tree_of_text(outcome)))
        if not num == len(kept.is_weak) == len(kept.exported.out_avals):
            return None
    except Exception:
        # Whatever is wrong with it, it is written again.
        return None
    with contextlib.suppress(OSError):
        # Files that nobody uses are deleted some day.
        path.touch()
    return kept


def _write(path: pathlib.Path, kept: _Kept) -> None:
    try:
        first = json.dumps([kept.outcome, kept.is_weak]).encode()
        atomic_write(path, first + b"\n" + kept.exported.serialize())
    except Exception:
        # It is not what was asked for: the next process traces again.
        return


def _name_of(function: Callable[..., Any]) -> list[str]:
    """Under which name a module has a function, and what of it was given.

    Raises:
        UnwritableError: no module of this library has it.
    """
    if isinstance(function, functools.partial):
        given = [list(function.args), sorted(function.keywords.items())]
        return [*_name_of(function.func), static_text(given)]
    name, module = getattr(function, "__qualname__", ""), function.__module__
    found = getattr(sys.modules.get(module), name, None)
    is_there = function in (found, getattr(found, "__wrapped__", None))
    if not is_there or not is_ours(module):
        raise UnwritableError(f"{module} has no {name!r}, or is not ours")
    return [f"{module}:{name}"]


@jax.jit
def _of_all_kinds(x):
    """A bit of everything."""
    keys = jax.random.split(jax.random.key(0))
    noise = jax.random.normal(keys[0], x.shape, x.dtype)
    noise = noise + jax.random.uniform(keys[1], x.shape, x.dtype)
    return x @ x, jnp.linalg.solve(x, noise), jnp.ones(2) * 1.5, jnp.arange(3)


def _circumstances() -> tuple[str, ...]:
    """All that a trace depends on but the function, its arguments and its source.

    Settings of JAX, of which there are many, some of them of a thread or of a block,
    show in what becomes of a function that has a bit of everything.
    """
    lowered = _of_all_kinds.lower(np.eye(3, dtype=np.float32))
    machine = f"{platform.machine()} {is_applied_once()}"
    return jax.default_backend(), lowered.as_text(), machine, *_versions()


@functools.cache
def _versions() -> tuple[str, ...]:
    """Versions of other libraries."""
    versions = [f"{name} {importlib.metadata.version(name)}" for name in _LIBRARIES]
    return platform.python_version(), *versions


def _source() -> str | None:
    """Every byte of this library; None if it may not be what this process loaded."""
    paths = _paths()
    if not paths or max(path.stat().st_mtime for path in paths) > _BEGUN:
        return None
    return _hash_of_source()


@functools.cache
def _paths() -> tuple[pathlib.Path, ...]:
    return tuple(sorted(_PACKAGE.rglob("*.py")))


@functools.cache
def _hash_of_source() -> str:
    source = hashlib.sha256()
    for path in _paths():
        source.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0")
        source.update(path.read_bytes() + b"\0")
    return source.hexdigest()
