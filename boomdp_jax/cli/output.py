"""What every command prints and where it may write."""

import importlib.util
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from boomdp_jax.core.atomic import check_folder_takes_files
from boomdp_jax.core.versions import library_versions

_FIGURE_SUFFIXES = (".png", ".pdf", ".svg")


def print_json(value: dict) -> None:
    """Print an object as one line; numbers that are not finite become null.

    Args:
        value: the object.
    """
    print(json.dumps(without_non_finite(value), allow_nan=False), flush=True)


def without_non_finite(value: object) -> object:
    """Replace infinities and NaN by None, at any depth.

    Args:
        value: what JSON can hold, otherwise.

    Returns:
        The same with None in their places.
    """
    if isinstance(value, dict):
        return {key: without_non_finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [without_non_finite(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def print_notes(notes: Sequence[str]) -> None:
    """Tell the user, on standard error, what a file means that may surprise.

    Args:
        notes: one sentence each.
    """
    for note in notes:
        print("boomdp_jax: note:", note, file=sys.stderr)


def check_writable(path: str | None) -> None:
    """Make sure before a long run that its result can be written.

    Args:
        path: where to; None: nowhere.

    Raises:
        ValueError: its folder is missing or takes no files, or it is a folder.
    """
    if path is None:
        return
    if not Path(path).parent.is_dir():
        raise ValueError(f"{path}: expected an existing folder to write to, got none")
    if Path(path).is_dir():
        raise ValueError(f"{path}: expected a file to write to, got a folder")
    try:
        check_folder_takes_files(path)
    except OSError as error:
        raise ValueError(
            f"{path}: expected a folder to write to, got one that takes no files "
            f"({error.strerror})"
        ) from error


def check_figure(path: str | None) -> None:
    """Make sure before a long run that its figure can be drawn.

    Args:
        path: where to; None: nowhere.

    Raises:
        ValueError: matplotlib is missing, or the kind of file is not known.
    """
    if path is None:
        return
    check_writable(path)
    if Path(path).suffix.lower() not in _FIGURE_SUFFIXES:
        raise ValueError(
            f"{path}: expected a figure that ends in {', '.join(_FIGURE_SUFFIXES)}, "
            f"got {Path(path).suffix!r}"
        )
    if importlib.util.find_spec("matplotlib") is None:
        raise ValueError(
            "--plot: expected matplotlib, got none; pip install 'boomdp_jax[plot]'"
        )


def numbered(path: str, index: int, num_files: int) -> str:
    """Name of one of several results.

    Args:
        path: the name as given.
        index: which result, from 0.
        num_files: how many there are.

    Returns:
        The name as given if there is one result, else with its number before the
        suffix.
    """
    if num_files == 1:
        return path
    whole = Path(path)
    return str(whole.with_name(f"{whole.stem}-{index}{whole.suffix}"))


def versions() -> dict[str, str]:
    """Versions of what computes, for result files.

    Returns:
        Version by distribution.
    """
    return library_versions(("boomdp_jax", "jax", "numpy"))
