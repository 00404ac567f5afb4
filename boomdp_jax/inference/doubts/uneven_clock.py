r"""Steps that do not last as long as told, by what is left of readings.

Where a step lasted longer than told by $\delta$ a body is farther along its way than
predicted, by $\dot x \delta$: whatever moves, and the more the faster. With whitened
innovations u and W the whitening, $a = (W \dot x) \cdot u / |W \dot x|$ then has the
variance $s^2 + \sigma^2 |W \dot x|^2$, and without it $s^2$, as what was taken for
noise of the motion is the same at all speeds. Poses alone are enough; where velocities
were read as well, `step_jitter` compares the two without any model.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Rows that it takes to say so.
_FEWEST = 20
# Share of rows that speak for it most and are left out: gross errors are few.
_LEFT_OUT = 0.02
# Ratios of both variances that are tried, where rows are of median speed.
_RATIOS = np.geomspace(1e-3, 1e5, 49)
# Evidence and share of a step from which on it is a doubt. What rubs and chatters on a
# floor errs more the faster it goes, too, by some hundredths of a step.
_DECISIVE, _LEAST_SHARE = 4.0, 0.1


class ClockError(NamedTuple):
    """How much steps seem to vary in length, of bodies that were read together."""

    sd: float
    """Of the length of a step about what was told [s]."""
    length: float
    """Of a step as told, the median [s]."""
    log_bayes_factor: float
    """For steps that vary against such that do not."""


def clock_error(
    innovation: Float[np.ndarray, "time channel"],
    rate: Float[np.ndarray, "time channel"],
    length: Float[np.ndarray, " time"],
) -> ClockError | None:
    """Compare innovations along the motion with how fast it was.

    Args:
        innovation: whitened, of the readings that end each step; zero where nothing was
            read.
        rate: derivative of what was to be read by time, whitened likewise [1/s].
        length: of each step as told [s].

    Returns:
        What was found, evidence by the Bayesian information criterion; None with too
        few readings, or where nothing moved.
    """
    speed = np.sqrt(np.sum(rate**2, axis=1))
    used = speed > 0.0
    count = int(np.sum(used))
    if count < _FEWEST:
        return None
    speed = speed[used]
    along = np.sum(innovation[used] * rate[used], axis=1) / speed
    if not np.any(along) or not np.all(np.isfinite(along)):
        return None
    spread = spread_along(along, speed)
    rest = np.argsort(spread.gain, kind="stable")
    rest = rest[: count - math.ceil(_LEFT_OUT * count)]
    if not np.any(along[rest]):
        return None
    gain = np.sum(spread_along(along[rest], speed[rest]).gain)
    return ClockError(
        sd=spread.sd,
        length=float(np.median(length[used])),
        log_bayes_factor=float(gain) - 0.5 * math.log(count),
    )


class Spread(NamedTuple):
    """Of what is left along the motion."""

    sd: float
    """Of a step's length, where that is likeliest [s]."""
    gain: Float[np.ndarray, " row"]
    """By how much likelier each row is then than without."""


def spread_along(
    along: Float[np.ndarray, " row"], speed: Float[np.ndarray, " row"]
) -> Spread:
    """Variances that grow with the square of the speed, or do not, at their likeliest.

    Args:
        along: normal with mean zero, not all zero.
        speed: positive [1/s].
    """
    square = speed**2
    ratio = np.append(0.0, _RATIOS / np.median(square))
    spread = 1.0 + ratio[:, None] * square
    unit = np.mean(along**2 / spread, axis=1)
    variance = unit[:, None] * spread
    each = -0.5 * (np.log(variance) + along**2 / variance)
    best = int(np.argmax(each.sum(axis=1)))
    return Spread(math.sqrt(ratio[best] * unit[best]), each[best] - each[0])


def clock_reason(found: ClockError, names: list[str]) -> str | None:
    """Why lengths of steps are not to be trusted, if they are not.

    Args:
        found: in a block.
        names: of its bodies.

    Returns:
        A line, or None.
    """
    share = found.sd / found.length
    if found.log_bayes_factor < _DECISIVE or share < _LEAST_SHARE:
        return None
    return (
        f"{'+'.join(names)}: what is left of its readings lies along its motion, the "
        f"more the faster it is, as if steps of {found.length:.3g} s were off by "
        f"{found.sd:.2g} s each (log Bayes factor {found.log_bayes_factor:.0f}): "
        "expected in dt how long each step lasted, frames that were left out included"
    )
