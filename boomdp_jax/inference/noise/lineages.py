r"""How many independent draws those of a few lineages are worth.

Resampling copies draws, and moves part the copies. Lineages are as good as independent,
copies within one are not: with $S_l$ the sum over lineage l, of $n_l$ draws, of a
number's offsets from the mean, the variance of the mean of N draws is about

$$\frac{1}{N^2} \frac{L-1}{L} \sum_l \left(\frac{S_l}{1 - n_l / N}\right)^2,$$

what leaving out one lineage after the other tells (Bell and McCaffrey 2002, Survey
Methodology 28, 169): a lineage that most draws are of has drawn the mean to itself, and
would else seem to lie on it. What N draws are worth is their variance over that.
"""

import numpy as np

# A group is asked if it has such a share of an object's draws, and so many of them.
_COUNTED_SHARE, _LEAST_GROUP = 0.05, 4
# Numbers that differ by less than this share of what they are do not.
_ROUNDING = 1e-9


def worth_of_draws(
    values: np.ndarray, offset: np.ndarray, root: np.ndarray, group: np.ndarray
) -> float:
    """Independent draws that those of one object are worth, by their worst number.

    Where there are several groups, that of which the share is worst: what its draws are
    worth, over how many they are, times all draws.

    Args:
        values: of every draw, `[draw, number]`.
        offset: of each from the mean of its group, angles the shorter way.
        root: which lineage each is of.
        group: of each, which no lineage leaves.
    """
    total = len(root)
    least = float(total)
    for name, num in zip(*np.unique(group, return_counts=True), strict=True):
        if num < max(_COUNTED_SHARE * total, _LEAST_GROUP):
            continue
        mine = offset[group == name]
        _, lineage, sizes = np.unique(
            root[group == name], return_inverse=True, return_counts=True
        )
        num_lineages = len(sizes)
        if num_lineages == num:
            continue
        if num_lineages == 1:
            return 1.0
        sums = np.zeros((num_lineages, mine.shape[1]))
        np.add.at(sums, lineage, mine)
        left_out = sums / (1.0 - sizes / num)[:, None]
        between = np.sum(left_out**2, axis=0) * (num_lineages - 1) / num_lineages
        square = np.sum(mine**2, axis=0)
        size = np.abs(values[group == name]).max(axis=0)
        seen = square > num * (_ROUNDING * size) ** 2
        share = square[seen] / np.maximum(between[seen], 1e-300)
        least = min(least, total * float(share.min(initial=1.0)))
    return least
