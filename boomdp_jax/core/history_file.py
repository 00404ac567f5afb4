"""Transition files: NPZ of the form `planar-transitions-1`, read and written whole."""

import dataclasses
import os
import warnings

import numpy as np

from boomdp_jax.core.history import History
from boomdp_jax.core.npz_file import read_npz, write_npz
from boomdp_jax.core.transition_table import (
    ObservedScene,
    TransitionTable,
    make_transition_table,
    match_scene,
)

TRANSITIONS_SCHEMA = "planar-transitions-1"
"""Version of the file format; files without one are taken for it."""

_KNOWN_ARRAYS = {
    "schema",
    "state",
    "action",
    "next_state",
    "dt",
    "episode",
    "point",
    "params",
}
_DT_TOLERANCE = 1e-5


def load_history(
    path: str | os.PathLike,
    *,
    spec: ObservedScene | None = None,
    capacity: int | None = None,
    num_rows: int | None = None,
) -> History:
    """Read a transition file as a history.

    The file's step length holds; if it is not the scene's there is a warning.

    Args:
        path: an NPZ file of the form `planar-transitions-1`.
        spec: scene to compare with: number of bodies, static bodies, step length.
        capacity: rows to make room for; default: as many as are read.
        num_rows: how many rows to read, from the first; default: all.

    Returns:
        The history, on the default float type.

    Raises:
        ValueError: one line with file, array and row, what was expected, what was got.
        OSError: the file cannot be read.
    """
    table = load_transitions(path, spec=spec, num_rows=num_rows)
    return table.to_history(capacity=capacity)


def load_transitions(
    path: str | os.PathLike,
    *,
    spec: ObservedScene | None = None,
    num_rows: int | None = None,
) -> TransitionTable:
    """Read a transition file as it stands, in 64 bit, on the host.

    Args:
        path: an NPZ file of the form `planar-transitions-1`.
        spec: scene to compare with.
        num_rows: how many rows to read, from the first; default: all.

    Returns:
        Its rows, with missing readings of static bodies filled in if there is a scene.

    Raises:
        ValueError: one line with file, array and row, what was expected, what was got.
        OSError: the file cannot be read.
    """
    if num_rows is not None and num_rows < 0:
        raise ValueError(f"num_rows: expected 0 or more, got {num_rows}")
    source, arrays = os.fspath(path), read_npz(path)
    schema = str(arrays.get("schema", TRANSITIONS_SCHEMA))
    if schema != TRANSITIONS_SCHEMA:
        raise ValueError(
            f"{source}: schema: expected {TRANSITIONS_SCHEMA!r}, got {schema[:60]!r}"
        )
    warn_of_unknown_arrays(arrays, _KNOWN_ARRAYS, source)
    table = make_transition_table(arrays, source)
    if num_rows is not None:
        table = _first_rows(table, num_rows)
    if spec is None:
        return table
    warn_of_other_dt(table.dt, spec, source)
    return match_scene(table, spec)


def save_history(
    path: str | os.PathLike, history: History, *, params: str | None = None
) -> None:
    """Write the rows of a history that are in use, whole or not at all.

    Args:
        path: where to; its folder must exist.
        history: one history, not a batch; missing readings are written as NaN.
        params: JSON about where the data came from.

    Raises:
        ValueError: a batch of histories.
    """
    if history.mask.ndim != 1:
        raise ValueError(
            f"history: expected one, got a batch of shape {history.mask.shape[:-1]}"
        )
    mask = np.asarray(history.mask)

    state, next_state = (
        np.where(np.asarray(is_read), np.asarray(reading, float), np.nan)
        for reading, is_read in (
            (history.state, history.state_mask),
            (history.next_state, history.next_state_mask),
        )
    )
    save_transitions(
        path,
        state=state[mask],
        action=np.asarray(history.action)[mask],
        next_state=next_state[mask],
        dt=np.asarray(history.dt)[mask],
        episode=np.asarray(history.episode)[mask],
        params=params,
    )


def save_transitions(
    path: str | os.PathLike,
    *,
    state: np.ndarray,
    action: np.ndarray,
    next_state: np.ndarray,
    dt: np.ndarray | float,
    episode: np.ndarray | None = None,
    point: np.ndarray | None = None,
    params: str | None = None,
) -> None:
    """Write a transition file from plain arrays, whole or not at all.

    Args:
        path: where to; its folder must exist.
        state: readings before each step, `[time, body, 6]`; NaN marks a missing one.
        action: wrenches, `[time, body, 3]` [N, N, N m].
        next_state: readings after each step, like `state`.
        dt: length of a step [s], one for all or one per row.
        episode: which run a row belongs to; default: one run.
        point: world point at which the force acts, `[time, body, 2]` [m]; NaN twice,
            or default: the reference point of the state, its centre of mass.
        params: JSON about where the data came from.

    Raises:
        ValueError: what `load_transitions` would refuse.
    """
    num_rows = len(state)
    arrays = {
        "schema": np.asarray(TRANSITIONS_SCHEMA),
        "state": np.asarray(state, float),
        "action": np.asarray(action, float),
        "next_state": np.asarray(next_state, float),
        "dt": np.asarray(dt, float),
        "episode": np.zeros(num_rows, np.int32) if episode is None else episode,
    }
    arrays["episode"] = np.asarray(arrays["episode"])
    if point is not None:
        arrays["point"] = np.asarray(point, float)
    if params is not None:
        arrays["params"] = np.asarray(params)
    table = make_transition_table(arrays, os.fspath(path))
    write_npz(path, {**arrays, "episode": table.episode})


def warn_of_unknown_arrays(
    arrays: dict[str, np.ndarray], known: set[str], source: str
) -> None:
    """Say which arrays of a file are left out, as their names may be mistyped.

    Args:
        arrays: arrays by name.
        known: names that mean something.
        source: name of the file.
    """
    unknown = sorted(arrays.keys() - known)
    if unknown:
        warnings.warn(
            f"{source}: ignored arrays {', '.join(unknown)[:200]}; known are "
            f"{', '.join(sorted(known))}",
            stacklevel=3,
        )


def warn_of_other_dt(dt: np.ndarray, spec: ObservedScene, source: str) -> None:
    """Say that a file's step length holds where it is not the scene's.

    Args:
        dt: length of each step in the file [s].
        spec: the scene.
        source: name of the file.
    """
    is_other = np.abs(dt - spec.dt) > _DT_TOLERANCE * spec.dt
    if np.any(is_other):
        length = f"{dt[is_other][0]:.6g} s overrides"
        if np.ptp(dt) > _DT_TOLERANCE * spec.dt:
            length = (
                f"{np.min(dt):.6g} to {np.max(dt):.6g} s (median {np.median(dt):.6g} "
                "s) override"
            )
        warnings.warn(
            f"{source}: dt: {length} the scene's {spec.dt:.6g} s",
            stacklevel=3,
        )


def _first_rows(table: TransitionTable, num_rows: int) -> TransitionTable:
    names = ("state", "action", "next_state", "dt", "episode")
    rows = {name: getattr(table, name)[:num_rows] for name in names}
    if table.point is not None:
        rows["point"] = table.point[:num_rows]
    return dataclasses.replace(table, **rows)
