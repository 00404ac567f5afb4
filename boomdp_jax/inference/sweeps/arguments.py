"""What users give to a sweep, checked before anything of it is written."""

import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from boomdp_jax.core.checked_input import whole_number
from boomdp_jax.core.history import History
from boomdp_jax.core.history_file import load_transitions
from boomdp_jax.inference.arguments import check_history, check_spec, kind_of
from boomdp_jax.inference.blocks.fixed_structure import (
    Structure,
    check_structure,
    different_scenes,
    fix_structure,
)
from boomdp_jax.inference.failures import listing
from boomdp_jax.inference.hypotheses.layout import block_layout, check_size
from boomdp_jax.inference.hypotheses.prior import read_prior
from boomdp_jax.inference.members import naming
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
    errors: list[OSError | ValueError] = []
    for number, (spec, source) in enumerate(zip(specs, histories, strict=True)):
        check_spec(spec, f"specs: object {number}")
        if isinstance(source, History):
            try:
                with naming(number, len(histories)):
                    check_history(spec, source)
            except ValueError as error:
                errors.append(error)
    _raise_together(errors, f"of {len(histories)}")
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


def check_scenes(
    specs: Sequence[SceneSpec], method: str, structure: Structure | None
) -> None:
    """Raise if there is a scene that cannot be inferred whatever its recording is.

    Args:
        specs: the scenes; one that is there many times is looked at once.
        method: as in `infer`.
        structure: as in `infer`.

    Raises:
        ValueError: a structure that does not go with them, a prior that makes no sense,
            or a body that alone has more structures than can be told apart.
    """
    check_structure(specs, method, structure)
    different = different_scenes(specs)
    for number, spec in different.items():
        with naming(number, len(different)):
            if structure is not None:
                spec = fix_structure(spec, structure)
            may_tie = read_prior(spec.prior, spec.source).probability["tie"] > 0
            for body in np.flatnonzero(~spec.is_static).tolist():
                alone = block_layout(spec, (body,), (), may_tie=may_tie)
                check_size(alone, spec.source)


def check_recordings(
    specs: Sequence[SceneSpec],
    histories: Sequence[Recording],
    numbers: Iterable[int],
    *,
    num_rows: int | None = None,
    needs_rows: bool = False,
) -> None:
    """Load files, so that what is wrong with any of them is known before the work.

    Args:
        specs: scenes of all objects.
        histories: recordings of all; those in memory have been looked at.
        numbers: which objects.
        num_rows: how many rows of each file to use; None: all.
        needs_rows: whether files without rows are refused.

    Raises:
        ValueError: a file that does not fit its scene; or several that do not, or
            cannot be read.
        OSError: a file, or several, that cannot be read.
    """
    errors: list[OSError | ValueError] = []
    num_files = 0
    for number in numbers:
        source = histories[number]
        if isinstance(source, History):
            continue
        num_files += 1
        try:
            table = load_transitions(source, spec=specs[number], num_rows=num_rows)
            if needs_rows and not table.num_rows:
                raise ValueError(f"{table.source}: expected at least one row, got none")
            table.to_history()
        except (OSError, ValueError) as error:
            errors.append(error)
    _raise_together(errors, f"of {num_files} files")


def _raise_together(errors: Sequence[OSError | ValueError], of_what: str) -> None:
    """Raise what was found wrong with recordings, a single thing as it is."""
    if not errors:
        return
    if len(errors) == 1:
        raise errors[0]
    lines = [
        f"{error.filename}: {error.strerror}"
        if isinstance(error, OSError) and error.filename
        else str(error)
        for error in errors
    ]
    kind = OSError if all(isinstance(e, OSError) for e in errors) else ValueError
    raise kind(
        f"histories: expected recordings that fit their scenes, got {len(errors)} "
        f"{of_what} that do not: {listing(lines)}"
    ) from errors[0]
