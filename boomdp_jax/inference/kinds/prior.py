"""What objects of one kind are believed to share before any is seen."""

import math
from typing import NamedTuple


class KindPrior(NamedTuple):
    r"""The base measure of the mixture over kinds, and its concentration.

    A coordinate of the kind that is standard normal a priori is drawn in two steps:
    $\mu \sim N(0, 1 - \tau^2)$ of the kind, $z \sim N(\mu, \tau^2)$ of each object,
    with a spread $\tau$ of its own for each coordinate of each kind, from a short
    list. A single object then has the ordinary prior, exactly and whatever $\tau$ is. A
    normal-inverse-gamma base measure would have given it the tails of a Student
    distribution. A heading is uniform, and of von Mises distribution within the kind.
    """

    spreads: tuple[float, ...] = (0.03, 0.1, 0.3, 1.0)
    """Sd of a coordinate within a kind, in units of its prior's; 1: not shared."""
    weights: tuple[float, ...] = (0.25, 0.45, 0.2, 0.1)
    """Probability of each of them."""
    structure_weight: float = 0.2
    """Pseudo-count of the ordinary structure prior in each kind. The second object of
    a kind has the structure of the first with probability one over one plus this, or
    more."""
    label_weight: float = 0.2
    """The same for labels."""
    vocabulary: int = 30
    """Labels that a new kind may have, equally probable: with few, two kinds would
    often have the same one by chance."""
    outline_spreads: tuple[float, ...] = (0.02, 0.1, 0.3, 1.0)
    """Sd of an outline's features within a kind, in units of their scale over kinds."""
    outline_weights: tuple[float, ...] = (0.4, 0.3, 0.2, 0.1)
    concentration_shape: float = 2.0
    """Of the gamma prior of the concentration: the expected number of kinds among n
    objects is about the concentration times log n."""
    concentration_rate: float = 2.0


def check_kind_prior(prior: KindPrior) -> None:
    """Refuse numbers that make no prior.

    Args:
        prior: what a user gave.

    Raises:
        ValueError: which number is wrong, and what was expected.
    """
    for name in ("spreads", "outline_spreads"):
        values = getattr(prior, name)
        weights_name = name.replace("spreads", "weights")
        weights = getattr(prior, weights_name)
        if not values or not all(0.0 < value <= 1.0 for value in values):
            raise ValueError(f"{name}: expected numbers in (0, 1], got {values}")
        if len(weights) != len(values) or not all(w > 0 for w in weights):
            raise ValueError(
                f"{weights_name}: expected {len(values)} positive weights, got "
                f"{weights}"
            )
    for name in (
        "structure_weight",
        "label_weight",
        "vocabulary",
        "concentration_shape",
        "concentration_rate",
    ):
        value = getattr(prior, name)
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name}: expected a positive number, got {value!r}")
