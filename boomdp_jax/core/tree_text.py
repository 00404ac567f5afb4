"""Trees of arrays as text: everything but the arrays, for files and their names.

JAX's own description of a tree (`jax.tree.structure`) cannot be stored. This one can,
for the trees that the library is made of: tuples, lists, dictionaries, named tuples and
modules of equinox, with plain values in static fields, all of types of its own.
"""

import dataclasses
import importlib
import json
from typing import Any

import equinox as eqx
import jax

# Whose types are described: of what may have changed since, nothing is.
_OURS = ("boomdp_jax", "builtins")


class UnwritableError(ValueError):
    """A tree of other things than can be written."""


def tree_text(tree: Any) -> str:
    """Describe a tree, so that `tree_of_text` makes it again but for its leaves.

    Args:
        tree: of arrays.

    Raises:
        UnwritableError: it, or a static field in it, is made of other things.
    """
    text = json.dumps(_written(tree), separators=(",", ":"))
    if jax.tree.structure(tree_of_text(text)) != jax.tree.structure(tree):
        raise UnwritableError(
            f"{type(tree).__name__} is more than can be written of it"
        )
    return text


def tree_of_text(text: str) -> Any:
    """The tree that was described; its leaves are True.

    Raises:
        UnwritableError: none was.
    """
    try:
        return _read(json.loads(text))
    except UnwritableError:
        raise
    except (AttributeError, ImportError, LookupError, TypeError, ValueError) as error:
        raise UnwritableError(f"no tree is described so: {error}") from None


def static_text(value: Any) -> str:
    """Describe what is no array: plain values, and tuples and lists of such.

    Raises:
        UnwritableError: it is something else.
    """
    return json.dumps(_written_static(value), separators=(",", ":"))


def _written(tree: Any) -> list:
    if tree is None:
        return ["none"]
    if isinstance(tree, dict):
        keys = [_written_static(key) for key in tree]
        return ["dict", keys, [_written(value) for value in tree.values()]]
    if isinstance(tree, tuple) and hasattr(tree, "_fields"):
        return ["named", _path(type(tree)), [_written(value) for value in tree]]
    if type(tree) in (tuple, list):
        return [type(tree).__name__, [_written(value) for value in tree]]
    if isinstance(tree, eqx.Module):
        values = [
            [
                field.name,
                *(
                    ["static", _written_static(getattr(tree, field.name))]
                    if field.metadata.get("static", False)
                    else ["field", _written(getattr(tree, field.name))]
                ),
            ]
            for field in dataclasses.fields(tree)
            if hasattr(tree, field.name)
        ]
        return ["module", _path(type(tree)), values]
    if not jax.tree_util.all_leaves([tree]):
        raise UnwritableError(f"a {type(tree).__name__} in a tree")
    return ["leaf"]


def _written_static(value: Any) -> list:
    if value is None or type(value) in (bool, int, str):
        return ["value", value]
    if type(value) is float:
        return ["float", value.hex()]
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return ["named", _path(type(value)), [_written_static(item) for item in value]]
    if type(value) in (tuple, list):
        return [type(value).__name__, [_written_static(item) for item in value]]
    if isinstance(value, type):
        return ["type", _path(value)]
    raise UnwritableError(f"a {type(value).__name__} in a static field")


def is_ours(module: str) -> bool:
    """Whether a module is of this library, or of the language."""
    return module.partition(".")[0] in _OURS


def _path(cls: type) -> str:
    if not is_ours(cls.__module__):
        raise UnwritableError(f"{cls.__module__}:{cls.__qualname__}, which is not ours")
    path = f"{cls.__module__}:{cls.__qualname__}"
    try:
        found = _at(path)
    except (AttributeError, ImportError):
        found = None
    if found is not cls:
        raise UnwritableError(f"{path}, which cannot be found by this name")
    return path


def _at(path: str) -> Any:
    module, _, names = path.partition(":")
    found: Any = importlib.import_module(module)
    for name in names.split("."):
        found = getattr(found, name)
    return found


def _read(written: list) -> Any:
    kind, *rest = written
    match kind:
        case "none":
            return None
        case "leaf":
            return True
        case "value":
            return rest[0]
        case "float":
            return float.fromhex(rest[0])
        case "type":
            return _at(rest[0])
        case "tuple":
            return tuple(map(_read, rest[0]))
        case "list":
            return list(map(_read, rest[0]))
        case "dict":
            return dict(zip(map(_read, rest[0]), map(_read, rest[1]), strict=True))
        case "named":
            return _at(rest[0])._make(map(_read, rest[1]))
        case "module":
            # Not by its constructor, which may check what are no arrays here.
            module = object.__new__(_at(rest[0]))
            for name, _, value in rest[1]:
                object.__setattr__(module, name, _read(value))
            return module
    raise UnwritableError(f"no tree is described by {kind!r}")
