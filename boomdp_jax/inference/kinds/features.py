"""What is seen of a body that is not touched: size and shape of its outline, a label.

Features are numbers of about unit scale over all sorts of things, so that their spread
within a kind is on the same list of spreads for each.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from boomdp_jax.physics.body_spec import BodySpec

OUTLINE_FEATURES = ("area", "aspect", "gyration", "corners")
"""Logarithms of area, of the ratio of its principal radii, of the mean square radius
over what a disc of the area has, and of the number of corners."""

_CENTRE = np.array([math.log(0.1), 0.5, 0.15, math.log(5.0)])
_SCALE = np.array([1.5, 0.5, 0.2, 0.5])
_CORNERS_OF_A_CIRCLE = 24.0


def outline_features(body: BodySpec) -> Float[np.ndarray, " feature"]:
    """Features of a body's outline, on their common scale.

    Args:
        body: the body.

    Returns:
        Numbers in the order of `OUTLINE_FEATURES`, each about standard normal over all
        sorts of things.
    """
    moments = body.moments
    low, high = np.linalg.eigvalsh(moments.covariance)
    disc = moments.area / (2.0 * np.pi)
    corners = len(body.outline) or _CORNERS_OF_A_CIRCLE
    raw = [
        math.log(moments.area),
        0.5 * math.log(max(high / low, 1.0)),
        math.log(moments.gyration / disc),
        math.log(corners),
    ]
    return (np.array(raw) - _CENTRE) / _SCALE


def number_labels(
    labels: Sequence[str | None], known: Sequence[str] = ()
) -> tuple[Int[np.ndarray, " body"], tuple[str, ...]]:
    """Number labels in the order of their first use.

    Args:
        labels: of bodies; None: none.
        known: labels that have a number already.

    Returns:
        A number for each, -1 for none, and all labels in order.
    """
    names = tuple(dict.fromkeys([*known, *(x for x in labels if x is not None)]))
    numbers = [-1 if label is None else names.index(label) for label in labels]
    return np.array(numbers, int), names
