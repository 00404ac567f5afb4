"""Scene files on disk: JSON of the schema `planar-scene-1`, read and written whole."""

import json
import os

from boomdp_jax.core.atomic import atomic_write
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict

MAX_SCENE_BYTES = 16 * 2**20
"""Largest scene file that is read (16 MiB)."""


def load_scene(path: str | os.PathLike) -> SceneSpec:
    """Read a scene file.

    Args:
        path: a JSON file of the schema `planar-scene-1`, at most `MAX_SCENE_BYTES`.

    Returns:
        The scene.

    Raises:
        ValueError: one line with file, body and field, what was expected, what was got.
        OSError: the file cannot be read.
    """
    with open(path, "rb") as file:
        content = file.read(MAX_SCENE_BYTES + 1)
    if len(content) > MAX_SCENE_BYTES:
        raise ValueError(
            f"{path}: expected a scene of at most {MAX_SCENE_BYTES} bytes, got more"
        )
    try:
        value = json.loads(
            content.decode("utf-8-sig"),
            object_pairs_hook=_object_without_repeats,
            parse_constant=_NotFinite,
        )
        found = _not_finite(value)
    except RecursionError as error:
        raise ValueError(f"{path}: expected JSON, got it nested too deep") from error
    except ValueError as error:
        message = " ".join(str(error).split())
        raise ValueError(
            f"{path}: expected JSON, got text that is not or is cut short ({message})"
        ) from error
    if found is not None:
        where, name = found
        raise ValueError(f"{path}: {where}{name} is not a finite number")
    return scene_spec_from_dict(value, source=str(path))


def save_scene(spec: SceneSpec, path: str | os.PathLike) -> None:
    """Write a scene file, whole or not at all.

    Args:
        spec: the scene.
        path: where to; its folder must exist.
    """
    text = json.dumps(spec.to_dict(), indent=1, allow_nan=False) + "\n"
    atomic_write(path, text.encode())


def _object_without_repeats(pairs: list[tuple[str, object]]) -> dict[str, object]:
    """A field that stands twice is a mistake of which JSON would keep half."""
    value = dict(pairs)
    if len(value) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"field {twice!r} stands twice in one object")
    return value


class _NotFinite(str):
    """`NaN`, `Infinity` or `-Infinity`, which JSON does not have but Python reads."""


def _not_finite(value: object) -> tuple[str, str] | None:
    """Where the first such number is, as messages say it, and what it is."""
    if isinstance(value, _NotFinite):
        return "", value
    inner: list[tuple[str, object]] = []
    if isinstance(value, dict):
        inner = [(f"{key}: ", each) for key, each in value.items()]
    elif isinstance(value, list):
        inner = [(f"[{number}]: ", each) for number, each in enumerate(value)]
    for where, each in inner:
        found = _not_finite(each)
        if found is None:
            continue
        name = each.get("name") if isinstance(each, dict) else None
        within = f"{name!r}: " if isinstance(name, str) else where
        return within + found[0], found[1]
    return None
