"""Predictions from readings taken as exact, row by row, and their density in full."""

import numpy as np
from scipy import stats

from boomdp_jax.core.history import History
from tests.inference.recordings import response, transition_matrix

# Prior scales of the noise of readings, of the channels x, y, theta and their rates.
SCALE = np.array([1e-3, 1e-3, 1e-3, 4e-3, 4e-3, 4e-3])
GROUPS = ((0, 1), (2,), (3, 4), (5,))


def windows(history: History, horizon: int | None) -> list[list[int]]:
    """Rows of each prediction, the way a person would mark them in the table."""
    state_is_whole = np.asarray(history.state_mask).all(axis=(1, 2))
    rows, episode = np.asarray(history.mask), np.asarray(history.episode)
    found: list[list[int]] = []
    is_open = False
    for row in np.flatnonzero(rows):
        if row == 0 or episode[row] != episode[row - 1]:
            is_open = False
        if is_open and len(found[-1]) == horizon:
            is_open = False
        if is_open:
            found[-1].append(int(row))
        elif state_is_whole[row]:
            found.append([int(row)])
            is_open = True
    return found


def log_student(errors: list[np.ndarray]) -> float:
    """Errors `[channel]`, NaN where none, of one body; noise integrated out.

    Normal errors whose variance is inverse-gamma of shape 1 and rate b are
    multivariate Student-t of two degrees of freedom and scale matrix b.
    """
    table = np.array(errors)
    total = 0.0
    for group in GROUPS:
        each = table[:, group].ravel()
        each = each[~np.isnan(each)]
        shape = SCALE[group[0]] ** 2 * np.eye(len(each))
        total += stats.multivariate_t.logpdf(each, shape=shape, df=2.0)
    return float(total)


def errors_of(history: History, predict, horizon: int | None) -> list[np.ndarray]:
    """Of everything that a prediction says, by going through the table row by row."""
    seen = np.asarray(history.state_mask), np.asarray(history.next_state_mask)
    first = np.where(seen[0], np.asarray(history.state), np.nan)[:, 0]
    last = np.where(seen[1], np.asarray(history.next_state), np.nan)[:, 0]
    found = []
    for rows in windows(history, horizon):
        now = first[rows[0]]
        for row in rows:
            if row != rows[0] and not history.is_chained[row]:
                found.append(first[row] - now)
            now = predict(now, np.asarray(history.action)[row, 0])
            found.append(last[row] - now)
    return found


def by_newton(mass: float):
    """A free box under a wrench that is held over a step."""
    return lambda now, wrench: transition_matrix() @ now + response(mass) @ wrench
