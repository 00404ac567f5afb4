"""Bodies of which a recording holds rows and not a single reading."""

import numpy as np

from boomdp_jax.core.history import History
from boomdp_jax.physics.scene_spec import SceneSpec


def unread_bodies(spec: SceneSpec, history: History) -> list[str]:
    """Bodies that can move and of which nothing was read.

    Args:
        spec: the scene.
        history: its readings.

    Returns:
        Their names; none where there are no rows, which asks for the prior.
    """
    rows = np.asarray(history.mask)
    if not np.any(rows):
        return []
    masks = (np.asarray(history.state_mask), np.asarray(history.next_state_mask))
    is_read = np.any([np.any(mask[rows], axis=(0, 2)) for mask in masks], axis=0)
    is_unread = ~is_read & ~np.asarray(spec.is_static)
    return [spec.names[body] for body in np.flatnonzero(is_unread)]


def is_unread(spec: SceneSpec, history: History) -> bool:
    """Whether there are rows, and nothing was read of any body that can move."""
    num_movable = int(np.sum(~np.asarray(spec.is_static)))
    return 0 < num_movable == len(unread_bodies(spec, history))


def unread_notes(spec: SceneSpec, history: History) -> list[str]:
    """Notes about bodies of which nothing was read.

    Such a body may be meant, one behind a wall, or be a recording that went wrong: the
    result is the prior either way, unless other bodies tell of it.

    Args:
        spec: the scene.
        history: its readings.

    Returns:
        One line for each.
    """
    num = int(np.sum(np.asarray(history.mask)))
    return [
        f"{name}: nothing was read of it in any of {num} rows"
        for name in unread_bodies(spec, history)
    ]
