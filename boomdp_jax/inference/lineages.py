r"""How many independent draws those of a few lineages are worth.

Resampling copies draws, and moves part the copies. Lineages are as good as independent,
copies within one are not: with $S_l$ the sum over lineage l of a number's offsets from
the mean, the variance of the mean of N draws is

$$\frac{1}{N^2} \frac{L}{L-1} \sum_l S_l^2,$$

however alike draws within a lineage are (Liang and Zeger 1986, Biometrika 73, 13). What
N draws are worth is their variance over that.
"""

import numpy as np

# Share of an object's draws that a group has to have to be asked.
_COUNTED_SHARE = 0.05


def worth_of_draws(offset: np.ndarray, root: np.ndarray, group: np.ndarray) -> float:
    """Independent draws that those of one object are worth, by their worst number.

    Args:
        offset: of every draw from the mean of its group, `[draw, number]`.
        root: which lineage each is of.
        group: of each, which no lineage leaves.
    """
    least, total = float(len(root)), len(root)
    for name, num in zip(*np.unique(group, return_counts=True), strict=True):
        if num < _COUNTED_SHARE * total:
            continue
        mine = offset[group == name]
        _, lineage = np.unique(root[group == name], return_inverse=True)
        num_lineages = lineage.max() + 1
        square = np.sum(mine**2, axis=0)
        seen = square > 0
        if num_lineages == 1:
            return 1.0
        sums = np.zeros((num_lineages, mine.shape[1]))
        np.add.at(sums, lineage, mine)
        between = np.sum(sums**2, axis=0) * num_lineages / (num_lineages - 1)
        share = square[seen] / np.maximum(between[seen], 1e-300)
        least = min(least, total * float(share.min(initial=1.0)))
    return least
