"""Numbers that have a period, as angles do, brought into half of it about zero."""

import numpy as np


def wrapped(values: np.ndarray, period: np.ndarray) -> np.ndarray:
    """Numbers with a period brought into half of it about zero.

    Args:
        values: `[*any, number]`.
        period: of each number; zero: it has none, and stays.
    """
    length = np.where(period > 0, period, 1.0)
    turned = values - length * np.floor(values / length + 0.5)
    return np.where(period > 0, turned, values)
