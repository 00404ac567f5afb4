"""Action files: NPZ with the wrenches that a simulation is to apply."""

import dataclasses
import os

import numpy as np
from jaxtyping import Float, Int

from boomdp_jax.core.history_file import warn_of_other_dt, warn_of_unknown_arrays
from boomdp_jax.core.npz_file import read_npz
from boomdp_jax.core.transition_table import (
    ObservedScene,
    check_action,
    check_num_bodies,
    read_array,
    read_dt,
    read_episode,
)

_KNOWN_ARRAYS = {"action", "initial_state", "dt", "episode", "point"}


@dataclasses.dataclass(frozen=True, eq=False)
class ActionTable:
    """Wrenches to apply, row by row."""

    action: Float[np.ndarray, "time body 3"]
    """Force [N] and torque [N m], held over a step."""
    initial_state: Float[np.ndarray, "body 6"] | None
    """Where each episode starts; None: where the scene says."""
    dt: Float[np.ndarray, " time"]
    """Length of each step [s]."""
    episode: Int[np.ndarray, " time"]
    """Which run a row belongs to."""
    point: Float[np.ndarray, "time body 2"] | None
    """World point at which the force acts [m]; None: the centre of mass."""
    source: str

    @property
    def is_start(self) -> np.ndarray:
        """Which rows begin an episode."""
        return np.diff(self.episode, prepend=self.episode[:1] - 1) != 0


def load_actions(path: str | os.PathLike, spec: ObservedScene) -> ActionTable:
    """Read an action file.

    Args:
        path: an NPZ file with `action`, and optionally `initial_state`, `dt`,
            `episode` and `point`.
        spec: scene to which the wrenches apply.

    Returns:
        The actions.

    Raises:
        ValueError: one line with file, array and row, what was expected, what was got.
        OSError: the file cannot be read.
    """
    source, arrays = os.fspath(path), read_npz(path)
    warn_of_unknown_arrays(arrays, _KNOWN_ARRAYS, source)
    action = read_array(arrays, "action", source, ("time", "body", 3))
    num_rows, num_bodies = action.shape[:2]
    check_num_bodies("action", num_bodies, spec, source)
    if not num_rows:
        raise ValueError(f"{source}: action: expected at least one row, got none")
    check_action(action, source)
    point = None
    if "point" in arrays:
        point = read_array(arrays, "point", source, (num_rows, num_bodies, 2))
        is_pushed = np.any(action[..., :2] != 0, axis=-1)
        is_lost = is_pushed & ~np.all(np.isfinite(point), axis=-1)
        if np.any(is_lost):
            row, body = np.argwhere(is_lost)[0]
            raise ValueError(
                f"{source}: point: expected a point wherever a force acts, got "
                f"{point[row, body].tolist()} in row {row}, body {spec.names[body]!r}"
            )
    dt = read_dt(arrays, source, num_rows, spec.dt)
    warn_of_other_dt(dt, spec, source)
    for body in np.flatnonzero(spec.is_static):
        if np.any(action[:, body] != 0):
            raise ValueError(
                f"{source}: body {spec.names[body]!r}: action: expected zeros, as the "
                "body is static, got others"
            )
    return ActionTable(
        action=action,
        initial_state=_read_initial_state(arrays, source, num_bodies, spec),
        dt=dt,
        episode=read_episode(arrays, source, num_rows),
        point=point,
        source=source,
    )


def _read_initial_state(
    arrays: dict[str, np.ndarray], source: str, num_bodies: int, spec: ObservedScene
) -> np.ndarray | None:
    if "initial_state" not in arrays:
        return None
    state = read_array(arrays, "initial_state", source, (num_bodies, 6))
    for body, name in enumerate(spec.names):
        where = f"{source}: body {name!r}: initial_state"
        if not np.all(np.isfinite(state[body])):
            raise ValueError(
                f"{where}: expected finite numbers, got {state[body].tolist()}"
            )
        if spec.is_static[body] and np.any(state[body, 3:] != 0):
            raise ValueError(
                f"{where}: expected zero twist, as the body is static, got "
                f"{state[body, 3:].tolist()}"
            )
    return state
