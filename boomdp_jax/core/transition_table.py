"""The arrays of a data file on the host, checked field by field before use."""

import dataclasses
import math
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from boomdp_jax.core.checked_input import (
    check_positive_seconds,
    check_real,
    episode_array,
    has_shape,
)
from boomdp_jax.core.history import History, make_history

_STATIC_TOLERANCE = 1e-3
"""How far a static body may be from where the scene has it [m, rad]; more is another
scene, less would refuse poses that were written with three digits."""


@runtime_checkable
class ObservedScene(Protocol):
    """What a data file is compared with; `physics.SceneSpec` is one."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the bodies."""
        ...

    @property
    def dt(self) -> float:
        """Length of a step [s]."""
        ...

    @property
    def is_static(self) -> np.ndarray:
        """Which bodies never move, `[body]`."""
        ...

    @property
    def pose(self) -> np.ndarray:
        """Where bodies start, `[body, 3]` [m, m, rad]; NaN where unknown."""
        ...


@dataclasses.dataclass(frozen=True, eq=False)
class TransitionTable:
    """Rows of a data file in 64 bit; NaN marks a reading that is missing."""

    state: Float[np.ndarray, "time body 6"]
    action: Float[np.ndarray, "time body 3"]
    next_state: Float[np.ndarray, "time body 6"]
    dt: Float[np.ndarray, " time"]
    episode: Int[np.ndarray, " time"]
    point: Float[np.ndarray, "time body 2"] | None
    """World point at which the force acts [m]; None, or NaN twice: the reference point
    of the state."""
    params: str | None
    """JSON about where the data came from; never used for inference."""
    source: str

    @property
    def num_rows(self) -> int:
        """How many transitions there are."""
        return len(self.dt)

    def to_history(self, *, capacity: int | None = None) -> History:
        """Put the rows on the device.

        Args:
            capacity: rows to make room for; default: as many as there are.

        Returns:
            The history, on the default float type.

        Raises:
            ValueError: a force acts at a point while the body's position is missing.
        """
        try:
            return make_history(
                self.state,
                self.action,
                self.next_state,
                self.dt,
                episode=self.episode,
                point=self.point,
                capacity=capacity,
            )
        except ValueError as error:
            raise ValueError(f"{self.source}: {error}") from error


def make_transition_table(
    arrays: dict[str, np.ndarray], source: str, *, default_dt: float | None = None
) -> TransitionTable:
    """Check shapes, kinds and numbers of the arrays of a data file.

    Args:
        arrays: arrays by their names in the file.
        source: name of the file, for messages.
        default_dt: length of a step if the file has none [s]; None: it must have one.

    Returns:
        The table.

    Raises:
        ValueError: which array is wrong, what was expected and what was got.
    """
    state = read_array(arrays, "state", source, ("time", "body", 6))
    num_rows, num_bodies = state.shape[:2]
    shape = (num_rows, num_bodies)
    next_state = read_array(arrays, "next_state", source, (*shape, 6))
    action = read_array(arrays, "action", source, (*shape, 3))
    for name, array in (("state", state), ("next_state", next_state)):
        if np.any(np.isinf(array)):
            row, body, _ = np.argwhere(np.isinf(array))[0]
            raise ValueError(
                f"{source}: {name}: expected finite readings, or NaN for a missing "
                f"one, got {array[row, body].tolist()} in row {row}, body {body}"
            )
    check_action(action, source)
    point = None
    if "point" in arrays:
        point = read_array(arrays, "point", source, (*shape, 2))
    params = arrays.get("params")
    return TransitionTable(
        state=state,
        action=action,
        next_state=next_state,
        dt=read_dt(arrays, source, num_rows, default_dt),
        episode=read_episode(arrays, source, num_rows),
        point=point,
        params=None if params is None else str(params),
        source=source,
    )


def read_array(
    arrays: dict[str, np.ndarray], name: str, source: str, shape: tuple
) -> np.ndarray:
    """Look up an array of real numbers of a given shape.

    Args:
        arrays: arrays by name.
        name: which one.
        source: name of the file, for messages.
        shape: sizes of its axes; text names an axis of any size.

    Returns:
        The array in 64 bit.

    Raises:
        ValueError: it is missing, is of another kind or has another shape.
    """
    if name not in arrays:
        found = ", ".join(sorted(arrays)) or "none"
        raise ValueError(f"{source}: expected an array {name!r}, got {found[:200]}")
    array = arrays[name]
    check_real(f"{source}: {name}", array.dtype)
    if not has_shape(array.shape, shape):
        wanted = ", ".join(map(str, shape))
        raise ValueError(
            f"{source}: {name}: expected shape [{wanted}], got {list(array.shape)}"
        )
    return np.asarray(array, float)


def check_action(action: np.ndarray, source: str) -> None:
    """Make sure that every wrench is finite.

    Args:
        action: wrenches, `[time, body, 3]`.
        source: name of the file, for messages.

    Raises:
        ValueError: one is not; which row, which body.
    """
    if not np.all(np.isfinite(action)):
        row, body, _ = np.argwhere(~np.isfinite(action))[0]
        raise ValueError(
            f"{source}: action: expected finite wrenches, got "
            f"{action[row, body].tolist()} in row {row}, body {body}"
        )


def read_dt(
    arrays: dict[str, np.ndarray], source: str, num_rows: int, default: float | None
) -> Float[np.ndarray, " time"]:
    """Look up the length of each step.

    Args:
        arrays: arrays by name.
        source: name of the file, for messages.
        num_rows: how many steps.
        default: length if the file has none [s]; None: it must have one.

    Returns:
        One length per step [s].

    Raises:
        ValueError: it is missing, has a wrong shape, or is not positive and finite.
    """
    if "dt" not in arrays and default is not None:
        return np.full(num_rows, default)
    shape = arrays["dt"].shape if "dt" in arrays else ()
    dt = read_array(arrays, "dt", source, (num_rows,) if shape else ())
    check_positive_seconds(f"{source}: ", dt, np.isfinite(dt) & (dt > 0))
    return np.broadcast_to(dt, (num_rows,))


def read_episode(
    arrays: dict[str, np.ndarray], source: str, num_rows: int
) -> Int[np.ndarray, " time"]:
    """Look up which run each row belongs to; one run if the file does not say.

    Args:
        arrays: arrays by name.
        source: name of the file, for messages.
        num_rows: how many rows.

    Returns:
        A number for each row; rows of one run follow each other.

    Raises:
        ValueError: a wrong shape or kind, or a run that is taken up again.
    """
    if "episode" not in arrays:
        return np.zeros(num_rows, np.int32)
    read_array(arrays, "episode", source, (num_rows,))
    given = arrays["episode"]
    if given.dtype.kind not in "iu":
        raise ValueError(
            f"{source}: episode: expected whole numbers of 32 bit, got an array of "
            f"{given.dtype}"
        )
    try:
        return episode_array(given, num_rows)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error


def match_scene(table: TransitionTable, spec: ObservedScene) -> TransitionTable:
    """Compare a table with the scene that it is said to describe.

    Args:
        table: the rows.
        spec: the scene.

    Returns:
        The table, with missing readings of static bodies filled in.

    Raises:
        ValueError: another number of bodies, or a static body that moves, is pushed or
            is not where the scene has it.
    """
    num_bodies = table.state.shape[1]
    check_num_bodies("state", num_bodies, spec, table.source)
    still = np.concatenate([spec.pose, np.zeros_like(spec.pose)], axis=-1)
    readings = {}
    for name in ("state", "next_state"):
        reading = getattr(table, name)
        is_fixed = np.isnan(reading) & spec.is_static[:, None]
        readings[name] = np.where(is_fixed, still, reading)
    for body in np.flatnonzero(spec.is_static):
        where = f"{table.source}: body {spec.names[body]!r}"
        both = np.concatenate([readings[name][:, body] for name in readings])
        if np.any(table.action[:, body] != 0):
            raise ValueError(
                f"{where}: action: expected zeros, as the body is static, got others"
            )
        if np.any(both[:, 3:] != 0) or np.any(both != both[:1]):
            raise ValueError(
                f"{where}: state: expected a constant pose and zero twist, as the body "
                "is static, got one that moves"
            )
        offset = both[:1, :3] - spec.pose[body]
        offset[:, 2] = np.mod(offset[:, 2] + math.pi, 2.0 * math.pi) - math.pi
        if np.any(np.abs(offset) > _STATIC_TOLERANCE):
            raise ValueError(
                f"{where}: state: expected the pose {spec.pose[body].tolist()} of the "
                f"scene, got {both[0, :3].tolist()}"
            )
    return dataclasses.replace(table, **readings)


def check_num_bodies(
    name: str, num_bodies: int, spec: ObservedScene, source: str
) -> None:
    """Make sure that an array describes as many bodies as the scene has.

    Args:
        name: name of the array.
        num_bodies: bodies in the array.
        spec: the scene.
        source: name of the file, for messages.

    Raises:
        ValueError: it does not.
    """
    if num_bodies != len(spec.names):
        raise ValueError(
            f"{source}: {name}: expected {len(spec.names)} bodies, as in the scene "
            f"({', '.join(spec.names)[:200]}), got {num_bodies}"
        )
