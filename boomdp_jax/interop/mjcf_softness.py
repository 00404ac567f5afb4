r"""How hard MuJoCo's constraints are, which in a planar scene give way nowhere.

A constraint is a damped spring, $\ddot r = -b \dot r - k r$ without loads, of
$b = 2 / t$ and $k = 1 / (t \zeta)^2$ for a `solref` of $(t, \zeta)$, or $(-k, -b)$ as
two negative numbers. `solimp` has the share of it that acts, which grows with $r$.
"""

import math
from typing import NoReturn

import numpy as np
from jaxtyping import Float

from boomdp_jax.interop.mjcf_document import Document

_LONGEST = 0.1
"""Time constant up to which a constraint counts as hard [s]: five times MuJoCo's own.
Ends of 0.08 s are usual, and mostly not reached."""

_LEAST_RATIO = 0.3
"""Damping ratio from which an end counts as one that does not throw back."""

_DEPTH = 0.01
"""Where the share of the spring that acts is taken [m, rad]."""


def check_hard(
    document: Document,
    kind: str,
    index: int,
    what: str,
    solref: Float[np.ndarray, "2"],
    solimp: Float[np.ndarray, "5"],
    *,
    is_stop: bool = False,
    most_steps: int = 4,
) -> None:
    """Refuse a constraint that is much softer than MuJoCo has them by default.

    Args:
        document: the world.
        kind: of the element, for messages.
        index: which one.
        what: ending of the names of both attributes, as `limit`.
        solref: spring and damper.
        solimp: the share of it that acts.
        is_stop: whether bodies hit it, so that too little damping throws them back.
        most_steps: time constant up to which it counts as hard, in MuJoCo's steps: for
            long ones, in which nothing can be harder.

    Raises:
        ValueError: it is soft, or throws back.
    """

    def say(expected: str) -> NoReturn:
        texts = (" ".join(f"{n:.6g}" for n in array) for array in (solref, solimp))
        got = "solref{0} {1} and solimp{0} {2}".format(what, *texts)
        document.refuse(kind, index, expected, got)

    first, second = (float(number) for number in solref)
    if (first > 0.0) != (second > 0.0):
        # MuJoCo then takes its default.
        first, second = 0.02, 1.0
    if first > 0.0:
        damping, stiffness = 2.0 / first, 1.0 / (first * second) ** 2
    else:
        damping, stiffness = -second, -first
    if damping <= 0.0 or stiffness <= 0.0:
        say("a constraint with stiffness and damping")
    # Friction has no deviation.
    depth = 0.0 if what == "friction" else _DEPTH
    share = impedance(solimp, depth) / max(float(solimp[1]), 1e-4)
    slow = max(2.0 / damping, 1.0 / math.sqrt(stiffness)) / share
    longest = max(_LONGEST, most_steps * float(document.model.opt.timestep))
    if slow > longest * (1.0 + 1e-9):
        say(
            "a constraint that is hard, with a time constant of at most "
            f"{longest:.6g} s (here {slow:.6g} s)"
        )
    if is_stop and damping < 2.0 * _LEAST_RATIO * math.sqrt(stiffness):
        say(f"a stop that does not throw back, with a damping ratio of {_LEAST_RATIO}")


def impedance(solimp: Float[np.ndarray, "5"], depth: float) -> float:
    """The share of a constraint's spring that acts at a deviation.

    Args:
        solimp: least and largest share, and how it grows from one to the other.
        depth: the deviation, at least 0 [m, rad].

    Returns:
        The share.
    """
    least, most, width, middle, power = (float(number) for number in solimp)
    least, most, middle = (min(max(n, 1e-4), 0.9999) for n in (least, most, middle))
    x = min(depth / max(width, 1e-15), 1.0)
    if x <= middle:
        y = middle * (x / middle) ** max(power, 1.0)
    else:
        y = 1.0 - (1.0 - middle) * ((1.0 - x) / (1.0 - middle)) ** max(power, 1.0)
    return least + y * (most - least)
