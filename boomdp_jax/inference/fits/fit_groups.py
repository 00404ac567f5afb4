"""Which of many fits are worth more work, by others of their structure and object."""

from collections.abc import Callable

import numpy as np

# Posterior standard deviations within which two fits lead to the same optimum.
_SAME = 0.3


class FitGroups:
    """Fits of the same object and structure, and of the same object."""

    def __init__(
        self,
        index: np.ndarray,
        structure: np.ndarray,
        num_objects: int,
        num_structures: int,
    ):
        """Sort them.

        Args:
            index: object of each fit.
            structure: of each fit.
            num_objects: of all.
            num_structures: of each object.
        """
        self._object, self._num_objects = index, num_objects
        self._group = index * num_structures + structure
        self._num = num_objects * num_structures

    def best(self, value: np.ndarray) -> np.ndarray:
        """Highest value of each one's structure."""
        return _highest(value, self._group, self._num)[self._group]

    def is_worth(self, value: np.ndarray, lack: np.ndarray) -> np.ndarray:
        """Whether each one's structure lacks little of the best of its object.

        Args:
            value: of each fit.
            lack: how much it may, for each object.
        """
        least = _highest(value, self._object, self._num_objects) - lack
        return self.best(value) >= least[self._object]

    def is_repeated(
        self,
        value: np.ndarray,
        z: np.ndarray,
        precision: np.ndarray,
        wrap: Callable[[np.ndarray], np.ndarray],
    ) -> np.ndarray:
        """Whether each one is about where the best of its structure is, and not that.

        Args:
            value: of each fit.
            z: of each fit, `[fit, dim]`.
            precision: at each fit, `[fit, dim, dim]`.
            wrap: brings differences of angles into half a period about zero.
        """
        order = np.argsort(value, kind="stable")
        champion = np.zeros(self._num, int)
        champion[self._group[order]] = order
        first = champion[self._group]
        offset = wrap(z - z[first])
        square = np.einsum("fi,fij,fj->f", offset, precision[first], offset)
        return (square < _SAME**2) & (first != np.arange(len(value)))


def _highest(value: np.ndarray, group: np.ndarray, num: int) -> np.ndarray:
    best = np.full(num, -np.inf)
    np.maximum.at(best, group, value)
    return best
