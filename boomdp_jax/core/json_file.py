"""Small JSON files that say what a folder holds: written whole, read without trust."""

import json
import os
from collections.abc import Mapping

from boomdp_jax.core.atomic import atomic_write

_MAX_BYTES = 2**24


def write_json(path: str | os.PathLike, content: Mapping) -> None:
    """Write an object, the whole file or nothing.

    Args:
        path: the file; its folder must exist.
        content: what JSON can hold.
    """
    atomic_write(path, (json.dumps(content, indent=1) + "\n").encode())


def read_json(path: str | os.PathLike, schema: str) -> dict:
    """Read an object of a schema.

    Args:
        path: the file.
        schema: what its entry `schema` must be.

    Returns:
        The object.

    Raises:
        ValueError: something else; one line.
        OSError: the file cannot be read.
    """
    with open(path, "rb") as file:
        content = file.read(_MAX_BYTES + 1)
    if len(content) > _MAX_BYTES:
        raise ValueError(f"{path}: expected at most {_MAX_BYTES} bytes, got more")
    try:
        found = json.loads(content)
    except ValueError as error:
        raise ValueError(f"{path}: expected JSON, got something else") from error
    got = found.get("schema") if isinstance(found, dict) else None
    if got != schema:
        raise ValueError(f"{path}: schema: expected {schema!r}, got {got!r}")
    return found


def check_same(
    path: str | os.PathLike, begun: Mapping, now: Mapping, prefix: str = ""
) -> None:
    """Refuse a folder that was begun with something else, naming the first of it.

    Args:
        path: the file that says what it was begun with.
        begun: its content.
        now: what it would be begun with now, as JSON has it.
        prefix: name of the entry that both are, with a dot.

    Raises:
        ValueError: they differ; one line.
    """
    for name in sorted(begun.keys() | now.keys()):
        old, new = begun.get(name), now.get(name)
        if old == new:
            continue
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            check_same(path, old, new, f"{prefix}{name}.")
        raise ValueError(
            f"{path}: {prefix}{name}: expected {json.dumps(old)}, as the folder was "
            f"begun with, got {json.dumps(new)}; choose another folder"
        )
