"""What JAX traced and lowered in one process, kept on disk for the next.

JAX keeps compiled programs (`kept_programs`), but finds them by the program itself,
which it has to trace and lower first: nine seconds for a filter of one body, of thirty
that an inference then takes. What functions of modules become depends on their source,
on the shapes and types of arguments, on static fields, versions and settings alone. A
file that is named after all these holds the lowered function (`jax.export`), so that
the next process has it in a tenth of a second.
"""

import functools
import hashlib
import importlib
import importlib.metadata
import inspect
import json
import pathlib
import platform
import sys
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.atomic import atomic_write
from boomdp_jax.core.tree_text import (
    UnwritableError,
    static_text,
    tree_of_text,
    tree_text,
)

TRACE_SUFFIX = ".trace"
"""Of names of files."""

# What a trace may depend on besides this library, by distribution.
_LIBRARIES = ("jax", "jaxlib", "numpy", "equinox", "jaxtyping", "numpyro")

_folder: pathlib.Path | None = None


def keep_traces(folder: pathlib.Path | None) -> None:
    """Keep traces from now on.

    Args:
        folder: where; it must exist. None: no longer.
    """
    global _folder
    _folder = folder


def are_traces_kept() -> bool:
    """Whether they are in this process."""
    return _folder is not None


def kept_trace(
    function: Callable[..., Any], static: Sequence[str] = ()
) -> Callable[..., Any]:
    """Let a function, when `jax.jit` traces it, be taken from disk.

    What comes from disk cannot be differentiated, nor mapped.

    Args:
        function: of trees of arrays. One that a module has by its name is kept, also
            with some plain arguments given (`functools.partial`); others, which may
            hold anything, are traced as ever, and so is what is given or returns other
            trees than `tree_text` describes.
        static: names of arguments that are not, hashable.

    Returns:
        The function.
    """
    names = tuple(inspect.signature(function).parameters) if static else ()

    @functools.wraps(function)
    def traced(*arguments: Any, **named: Any) -> Any:
        ordered, given, fixed = arguments, dict(named), {}
        if static:
            ordered = ()
            given |= dict(zip(names, arguments, strict=False))
            fixed = {name: given.pop(name) for name in static if name in given}
        kept = _kept(function, fixed, (ordered, given))
        if kept is None:
            return function(*arguments, **named)
        exported, outcome = kept
        leaves = exported.call(*jax.tree.leaves((ordered, given)))
        return jax.tree.unflatten(jax.tree.structure(tree_of_text(outcome)), leaves)

    return traced


def _kept(function, static: dict[str, Any], given: tuple[tuple, dict]):
    """A function of leaves, from disk or put there, and the tree that it returns.

    None if it cannot be kept.
    """
    folder = _folder
    types = [jax.typeof(leaf) for leaf in jax.tree.leaves(given)]
    try:
        name, *texts = _name_of(function)
        texts += [tree_text(given), static_text(sorted(static.items()))]
    except UnwritableError:
        return None
    if folder is None:
        return None
    known = json.dumps([name, *texts, *map(str, types), *_circumstances()])
    digest = hashlib.sha256(known.encode()).hexdigest()
    path = folder / f"{name.rpartition(':')[2]}-{digest}{TRACE_SUFFIX}"
    read = _read(path)
    if read is not None:
        return read
    outcome = ""

    def of_leaves(*leaves):
        nonlocal outcome
        ordered, given_now = jax.tree.unflatten(jax.tree.structure(given), leaves)
        found = function(*ordered, **given_now, **static)
        outcome = tree_text(found)
        return jax.tree.leaves(found)

    try:
        exported = _export().export(jax.jit(of_leaves))(*types)
    except Exception:
        # It may not be of a kind that can be kept. If it is wrong, then tracing it as
        # ever says so.
        return None
    _write(path, exported, outcome)
    return exported, outcome


def _export() -> Any:
    # Not loaded where nothing is kept.
    return importlib.import_module("jax.export")


def _read(path: pathlib.Path):
    """What is in a file, if it is there and whole."""
    try:
        outcome, _, content = path.read_bytes().partition(b"\n")
        exported = _export().deserialize(bytearray(content))
        # Files that nobody uses are deleted some day.
        path.touch()
    except Exception:
        # Whatever is wrong with it, it is written again.
        return None
    return exported, outcome.decode()


def _write(path: pathlib.Path, exported, outcome: str) -> None:
    try:
        atomic_write(path, outcome.encode() + b"\n" + exported.serialize())
    except (OSError, ImportError, ValueError, NotImplementedError):
        # Then the next process traces again.
        return


def _name_of(function: Callable[..., Any]) -> list[str]:
    """Under which name a module has a function, and what of it was given.

    Raises:
        UnwritableError: none has it.
    """
    if isinstance(function, functools.partial):
        given = [list(function.args), sorted(function.keywords.items())]
        return [*_name_of(function.func), static_text(given)]
    name, module = getattr(function, "__qualname__", ""), function.__module__
    found = getattr(sys.modules.get(module), name, None)
    if function not in (found, getattr(found, "__wrapped__", None)):
        raise UnwritableError(f"{module} has no {name!r}")
    return [f"{module}:{name}"]


@jax.jit
def _of_all_kinds(x):
    """A bit of everything."""
    key = jax.random.key(0)
    noise = jax.random.normal(key, x.shape) + jax.random.uniform(key, x.shape)
    return x @ x, jnp.linalg.solve(x, noise), jnp.ones(2) * 1.5, jnp.arange(3)


def _circumstances() -> tuple[str, ...]:
    """All that a trace depends on but the function and its arguments.

    Settings of JAX, of which there are many, some of them of a thread or of a block,
    show in what becomes of a function that has a bit of everything.
    """
    lowered = _of_all_kinds.lower(np.eye(3, dtype=np.float32))
    return jax.default_backend(), lowered.as_text(), *_versions()


@functools.cache
def _versions() -> tuple[str, ...]:
    """Versions of other libraries, and of this one every byte."""
    package = pathlib.Path(__file__).parents[1]
    source = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        source.update(path.relative_to(package).as_posix().encode() + b"\0")
        source.update(path.read_bytes() + b"\0")
    versions = [f"{name} {importlib.metadata.version(name)}" for name in _LIBRARIES]
    return platform.python_version(), source.hexdigest(), *versions
