"""Which kind of move goes farther, group by group of draws."""

import numpy as np

from boomdp_jax.inference.samplers.draw_moves import are_enough

# Where moves go less far than this, every so many are of the other kind, but where that
# is known to go less than such a share as far.
_POOR, _EVERY, _CLOSE = 0.1, 4, 0.3


class MoveKinds:
    """Chooses between moves about means and by differences (`draw_moves`)."""

    def __init__(self, num_groups: int):
        """Begin with moves about means, of which a few do where posteriors are normal.

        Args:
            num_groups: groups of draws there are.
        """
        self._reach = np.stack([np.full(num_groups, np.inf), np.zeros(num_groups)])
        self._is_known = np.zeros((2, num_groups), bool)
        self._number = 0

    def choose(self, values: np.ndarray, group: np.ndarray) -> np.ndarray:
        """Of which groups the next move is to be about their means, `[group]`.

        Args:
            values: of the draws that will move, `[draw, number]`.
            group: of each.
        """
        self._number += 1
        is_about_mean = self._reach[0] >= self._reach[1]
        if self._number % _EVERY == 0:
            less, more = self._reach.min(axis=0), self._reach.max(axis=0)
            is_far_less = (less < _CLOSE * more) & np.all(self._is_known, axis=0)
            is_tried = (more < _POOR) & ~is_far_less
            is_about_mean = is_about_mean ^ is_tried
        enough = are_enough(values, group)
        is_about_mean[len(enough) :] = False
        is_about_mean[: len(enough)] &= enough
        return is_about_mean

    def learn(
        self,
        is_about_mean: np.ndarray,
        before: np.ndarray,
        after: np.ndarray,
        group: np.ndarray,
    ) -> None:
        """Take note of how far draws went.

        Args:
            is_about_mean: what was chosen.
            before: where draws were, `[draw, number]`.
            after: where they are.
            group: of each draw.
        """
        for name in np.unique(group):
            mine = group == name
            kind = 0 if is_about_mean[name] else 1
            self._reach[kind, name] = reach(before[mine], after[mine])
            self._is_known[kind, name] = True


def reach(before: np.ndarray, after: np.ndarray) -> float:
    """Mean square of a move over the variance, of the middle one of all numbers.

    Zero where no number varies, as with a single draw.
    """
    spread = after.var(axis=0)
    seen = spread > 0
    if not np.any(seen):
        return 0.0
    square = np.mean((after - before)[:, seen] ** 2, axis=0)
    return float(np.median(square / spread[seen]))
