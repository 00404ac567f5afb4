"""What users give to a sweep, checked before anything of it is written."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

from boomdp_jax.core.checked_input import whole_number
from boomdp_jax.core.history import History
from boomdp_jax.inference.arguments import check_history, check_spec, kind_of
from boomdp_jax.physics.scene_spec import SceneSpec

Recording = History | str | os.PathLike
"""Of one object: itself, or its file."""


def listed(
    specs: Any, histories: Any
) -> tuple[tuple[SceneSpec, ...], tuple[Recording, ...]]:
    """Scenes and recordings, one for each object.

    Args:
        specs: one scene for all, or a list.
        histories: a list, or a single one.

    Raises:
        TypeError: something else.
        ValueError: no recording, not as many as scenes, or one in memory that does not
            fit its scene.
    """
    if isinstance(histories, Recording):
        histories = [histories]
    if not isinstance(histories, Sequence):
        raise TypeError(
            "histories: expected a History or the path of a file, or a list of them; "
            f"got {kind_of(histories)}"
        )
    if not histories:
        raise ValueError("histories: expected at least one, got none")
    for number, source in enumerate(histories):
        if not isinstance(source, Recording):
            raise TypeError(
                f"histories: object {number}: expected a History or the path of a "
                f"file; got {kind_of(source)}"
            )
    if isinstance(specs, SceneSpec):
        specs = [specs] * len(histories)
    if isinstance(specs, str) or not isinstance(specs, Sequence):
        raise TypeError(
            f"specs: expected a SceneSpec or a list of them; got {kind_of(specs)}"
        )
    if len(specs) != len(histories):
        raise ValueError(
            f"histories: expected one per scene, {len(specs)}, got {len(histories)}"
        )
    for number, (spec, source) in enumerate(zip(specs, histories, strict=True)):
        check_spec(spec, f"specs: object {number}")
        if isinstance(source, History):
            check_history(spec, source)
    return tuple(specs), tuple(histories)


def checked_num_rows(num_rows: Any, histories: Sequence[Recording]) -> int | None:
    """How many rows of each file to use; None: all.

    Raises:
        ValueError: no whole number, or there are recordings that are not files.
    """
    if num_rows is None:
        return None
    if any(isinstance(source, History) for source in histories):
        raise ValueError(
            "num_rows: of files: expected None with histories in memory, got "
            f"{num_rows!r}"
        )
    return whole_number("num_rows", num_rows, 0)


def checked_shard(shard: Any) -> tuple[int, int]:
    """A shard (i, n), of which it is not said that it has any units.

    Raises:
        ValueError: no pair of whole numbers, or i out of range.
    """
    try:
        place, num = (whole_number("shard", part, 0) for part in shard)
    except (TypeError, ValueError):
        place = num = 0
    if place >= num:
        raise ValueError(f"shard: expected (i, n) with 0 <= i < n, got {shard!r}")
    return place, num


def structure_for_file(structure: Any) -> dict[str, Any] | None:
    """A structure in a form that the folder's file can keep.

    `infer` takes a choice of slots too, which says nothing without its scene.

    Raises:
        TypeError: no mapping.
    """
    if structure is None:
        return None
    if not isinstance(structure, Mapping):
        raise TypeError(
            "structure: expected a mapping from body to kinds; got "
            f"{kind_of(structure)}"
        )
    return dict(structure)


def check_files(histories: Sequence[Recording]) -> None:
    """Raise an OSError unless all recordings that are files can be opened."""
    for source in histories:
        if not isinstance(source, History):
            with open(source, "rb"):
                pass
