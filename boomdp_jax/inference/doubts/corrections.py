r"""Do readings correct a body's motion the same way again and again?

A force that the model lacks is taken for noise of the motion, and a filter follows it
with gains that leave innovations nearly white. By how much it corrects a body's twist,
$k_t$, is as it should be then; but over a push all $k_t$ point the same way, though
noise of the motion would not: predictions over many steps, whose variance is a sum of
the variances of steps, are too sure. With windows w of h rows,

$$\rho = \sum_w |\sum_{t \in w} k_t|^2 / \sum_w \sum_{t \in w} |k_t|^2$$

is one on average where the model is right, whatever the sizes of $k_t$ (the variance
ratio of Lo and MacKinlay 1988, Stock market prices do not follow random walks). Noise
of readings that is not white is corrected back, and makes no more of it.
"""

import math
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from boomdp_jax.inference.likelihoods.tracking import Gains

# Rows of a window, and how many a body needs.
_WINDOW, _FEWEST = 20, 60
# Noise of the motion by what pushes do, and ratio and score, from which on motion does
# not follow wrenches. Of 84 objects in MuJoCo with right wrenches (free, hinged, on a
# slide, on wheels, on a floor, hinged on a floor) noise came to 0.55 at most, but for a
# free box in a high draw and one that hung and rubbed (7.7), neither of which went one
# way. With an axis of forces negated or two exchanged, which a door may take for a mass
# that nothing moves, it came to 0.1 to 470, ratios mostly to 4 and more.
_MOST_BY_CHANCE = 1.0
_LEAST_RATIO, _LEAST_SCORE = 2.0, 3.0


class Persistence(NamedTuple):
    """How corrections of one body add up."""

    ratio: float
    """Variance of their sums over a window, by the one of as many that are white."""
    score: float
    """By how much it is more than one, in its own sds if signs were by chance."""


def unmoved_reason(
    name: str, found: dict[str, Persistence], by_chance: float
) -> str | None:
    """Why pushes are not what they are told to be, where they do next to nothing.

    Args:
        name: of the body.
        found: of it.
        by_chance: changes of velocity by noise of the motion, per those by pushes.

    Returns:
        A line, or None: disturbances that are noise indeed do not go one way.
    """
    one = found.get("velocity")
    if one is None or not by_chance > _MOST_BY_CHANCE:
        return None
    if one.ratio < _LEAST_RATIO or one.score < _LEAST_SCORE:
        return None
    return (
        f"{name}: chance is taken to change its velocity {by_chance:.2g} times as much "
        "as what pushes it, and the same way again and again: its motion does not "
        "follow the wrenches; expected their axes, signs and units as those of the "
        "poses, and all that pushes it"
    )


def persistence_note(name: str, channel: str, found: Persistence) -> str:
    """What it says of predictions.

    Args:
        name: of the body.
        channel: `velocity` or `spin`.
        found: of it.
    """
    return (
        f"{name}: readings correct its {channel} the same way again and again, over "
        f"{_WINDOW} rows {math.sqrt(found.ratio):.1f} times as far as by chance: "
        "something acts on it that the model does not have, and predictions over many "
        "rows are too sure"
    )


def moved_by_readings(
    gains: Gains, innovation: Float[np.ndarray, "time 2 body 6"]
) -> tuple[Float[np.ndarray, "time body 6"], Float[np.ndarray, "time body 6"]]:
    """By how much the two readings of each step move the estimate.

    Args:
        gains: of the filter.
        innovation: whitened.

    Returns:
        By what a step starts from, and by what ends it.
    """
    shape = innovation[:, 0].shape

    def moved(gain, whitening, error) -> np.ndarray:
        seen = np.diagonal(whitening, axis1=1, axis2=2) > 0
        root = whitening + np.eye(seen.shape[1]) * ~seen[:, None]
        miss = np.linalg.solve(root, error.reshape(len(error), -1, 1))
        return (gain @ miss)[..., 0].reshape(shape)

    parts = jax.tree.map(lambda leaf: np.asarray(leaf, float), gains)
    first = moved(parts.first, parts.first_whitening, innovation[:, 0])
    return first, moved(parts.last, parts.last_whitening, innovation[:, 1])


def persistence_by_body(
    first: Float[np.ndarray, "time body 6"],
    last: Float[np.ndarray, "time body 6"],
    run: Int[np.ndarray, " time"],
) -> tuple[dict[str, Persistence], ...]:
    """Of each body, of its velocity and its spin.

    Args:
        first: by how much what each step starts from moves the estimate.
        last: the reading that ends it.
        run: which run each step belongs to.
    """
    whole = last.copy()
    # A step may start from another reading of the instant at which the last one ended.
    goes_on = (run[1:] == run[:-1])[:, None, None]
    whole[:-1] += np.where(goes_on, first[1:], 0.0)
    found = []
    for body in range(whole.shape[1]):
        each = {
            name: persistence(whole[:, body, channels], run)
            for name, channels in (("velocity", slice(3, 5)), ("spin", slice(5, 6)))
        }
        found.append({name: one for name, one in each.items() if one is not None})
    return tuple(found)


def persistence(
    correction: Float[np.ndarray, "time channel"], run: Int[np.ndarray, " time"]
) -> Persistence | None:
    """Whether corrections of a group of channels go on in one direction.

    Args:
        correction: by the readings of each row; zero where there are none.
        run: which run each row belongs to; windows lie within one.

    Returns:
        What was found; None with too few rows, or where nothing was corrected.
    """
    is_corrected = np.any(correction != 0.0, axis=1)
    if np.sum(is_corrected) < _FEWEST or not np.all(np.isfinite(correction)):
        return None
    both, spread = 0.0, 0.0
    for lag in range(1, _WINDOW):
        pairs = np.sum(correction[lag:] * correction[:-lag], axis=1)
        pairs = (1.0 - lag / _WINDOW) * pairs[run[lag:] == run[:-lag]]
        both += float(np.sum(pairs))
        spread += float(np.sum(pairs**2))
    if spread == 0.0:
        return None
    size = float(np.sum(correction**2))
    return Persistence(1.0 + 2.0 * both / size, both / math.sqrt(spread))
