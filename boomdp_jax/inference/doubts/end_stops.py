"""Drawers and doors that come against a stop, which no hypothesis knows of.

Taken for noise of the motion what a stop takes away makes masses several times too
large: it always opposes what pushes towards it. Rows between the ends alone tell what
moves the thing.
"""

import numpy as np

from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.doubts.held_back import is_held_back, near_ends
from boomdp_jax.inference.doubts.way_of_body import Way, end_of_each, find_ways
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.physics.scene_arrays import has_contact
from boomdp_jax.physics.scene_spec import SceneSpec


def without_stops(posterior: Posterior, history: History) -> tuple[History, list[str]]:
    """Rows in which nothing can have come against a stop at an end of its way.

    Args:
        posterior: what was inferred of all rows.
        history: all rows.

    Returns:
        The rows between the ends, to be inferred from anew, of which another episode
        begins after each gap: the same history where no body is held back. A line for
        each body that is.
    """
    is_free, notes = np.asarray(history.mask).copy(), []
    for body, way in _stopped_ways(posterior.spec, history, posterior):
        rows = np.flatnonzero(np.asarray(history.mask))
        end = end_of_each(history)
        begin = end - 1
        known = np.flatnonzero(np.isfinite(way.place))
        place = np.interp(way.time, way.time[known], way.place[known])
        came = np.where(
            begin > 0, place[begin] - place[np.maximum(begin - 1, 0)], 0.0
        ) * (way.run[begin] == way.run[np.maximum(begin - 1, 0)])
        ahead = place[begin] + came
        is_high, is_low = near_ends(way, np.stack([place[begin], place[end], ahead]))
        is_near = is_high | is_low
        is_free[rows[is_near]] = False
        name, count = posterior.spec.names[body], f"{is_near.sum()} of {len(rows)}"
        notes.append(
            f"{name}: {count} rows are left out, in which it may have come against a "
            f"stop at the ends of {way.name}"
        )
    if not notes:
        return history, []
    return _only(history, is_free, _reach(posterior)), notes


def _reach(posterior: Posterior) -> float:
    """How long ago a command may have been given that is in effect [s]."""
    actuator = posterior.params.actuator
    if actuator is None or actuator.delay is None:
        return 0.0
    return float(np.max(np.asarray(actuator.delay), initial=0.0))


def _only(history: History, is_kept: np.ndarray, reach: float) -> History:
    """Some rows, of which another episode begins after each gap.

    Commands from before a gap may still be in effect after it: rows that are so near
    come first, without their readings.
    """
    kept, mask = np.flatnonzero(is_kept), np.asarray(history.mask)
    before, dt = np.asarray(history.episode), np.asarray(history.dt)
    begins = (np.diff(kept, prepend=-2) > 1) | (np.diff(before[kept], prepend=-1) != 0)
    rows, is_read, episode = [], [], []
    pieces = np.split(kept, np.flatnonzero(begins)[1:]) if len(kept) else []
    for number, run in enumerate(pieces):
        first = run[0]
        while (
            first > 0
            and mask[first - 1]
            and before[first - 1] == before[run[0]]
            and dt[first : run[0]].sum() < reach
        ):
            first -= 1
        num_unread = run[0] - first
        rows += [*range(first, run[0]), *run]
        is_read += [False] * num_unread + [True] * len(run)
        episode += [number] * (num_unread + len(run))
    index, told = np.array(rows, int), np.array(is_read, bool)
    # What a row ends at is where the next one starts.
    is_last_told = told | (np.append(told[1:], False))
    state, next_state = (
        np.where(
            np.asarray(there)[index] & use[:, None, None],
            np.asarray(values)[index],
            np.nan,
        )
        for values, there, use in (
            (history.state, history.state_mask, told),
            (history.next_state, history.next_state_mask, is_last_told),
        )
    )
    return make_history(
        state,
        np.asarray(history.action)[index],
        next_state,
        dt[index],
        episode=np.array(episode, int),
        capacity=max(history.capacity, len(index)),
    )


def end_stop_reasons(
    spec: SceneSpec, history: History, posterior: Posterior
) -> list[str]:
    """Reasons for doubt about bodies that are held back at the ends of their way.

    Args:
        spec: the scene, for names.
        history: its readings.
        posterior: what was inferred of it; says where pins are.

    Returns:
        One line for each body that goes along a line or turns about a pin, and is
        stopped at an end of that. Scenes with contact are not asked, nor what friction
        holds elsewhere.
    """
    return [
        f"{spec.names[body]}: is held back at the ends of {way.name}, as by a stop or "
        "a spring, which no hypothesis knows of; expected rows between the ends alone"
        for body, way in _stopped_ways(spec, history, posterior)
    ]


def _stopped_ways(
    spec: SceneSpec, history: History, posterior: Posterior
) -> list[tuple[int, Way]]:
    """Bodies that are held back, and the way at whose ends they are."""
    if has_contact(spec.bodies) or not np.any(np.asarray(history.mask)):
        return []
    found = []
    for body in np.flatnonzero(~np.asarray(spec.is_static)):
        ways = find_ways(spec, history, posterior, int(body))
        found += [(int(body), way) for way in ways if is_held_back(way)][:1]
    return found
