"""What may be asked of sparse sampling, checked before anything is compiled."""

from typing import Any

import equinox as eqx
import numpy as np

from boomdp_jax.planning.merging import OVERFLOW_POLICIES
from boomdp_jax.planning.problem import check_number, check_positive
from boomdp_jax.planning.risk import RISK_MEASURES

HYPOTHESES = ("root", "fresh", "map", "mean", "adaptive")


class Options(eqx.Module):
    """What is static of a search."""

    num_samples: tuple[int, ...] = eqx.field(static=True)
    hypotheses: str = eqx.field(static=True)
    num_hypotheses: int = eqx.field(static=True)
    risk: str = eqx.field(static=True)
    common_random_numbers: bool = eqx.field(static=True)
    capacity: int = eqx.field(static=True)
    overflow: str = eqx.field(static=True)
    verify: bool = eqx.field(static=True)
    keep_tree: bool = eqx.field(static=True)


def draws_by_level(num_samples: Any, depth: int) -> tuple[int, ...]:
    """One number of draws for each level."""
    if isinstance(num_samples, int | np.integer):
        return (check_positive("num_samples", num_samples),) * depth
    draws = tuple(num_samples)
    if len(draws) != depth:
        raise ValueError(
            f"num_samples: expected one number, or one for each of {depth} levels; got "
            f"{draws}"
        )
    return tuple(check_positive("num_samples", number) for number in draws)


def check_options(
    *,
    depth: int,
    hypotheses: str,
    risk: str,
    risk_level: Any,
    overflow: str,
    likelihood_fn: Any,
    cell_size: Any,
    verify: bool,
) -> None:
    """Options that are names, and what goes with what."""
    for name, value, known in (
        ("hypotheses", hypotheses, HYPOTHESES),
        ("risk", risk, RISK_MEASURES),
        ("overflow", overflow, OVERFLOW_POLICIES),
    ):
        if value not in known:
            raise ValueError(f"{name}: expected one of {known}; got {value!r}")
    check_number("risk_level", risk_level, "in (0, 1]", lambda x: 0.0 < x <= 1.0)
    if isinstance(cell_size, str) and cell_size != "auto":
        raise ValueError(
            f"cell_size: expected sizes, 'auto' or None; got {cell_size!r}"
        )
    if verify and hypotheses in ("fresh", "adaptive"):
        raise ValueError(
            "verify: plans are followed under one hypothesis each; expected hypotheses "
            f"'root', 'map' or 'mean', got {hypotheses!r}"
        )
    if hypotheses == "adaptive":
        if likelihood_fn is None:
            raise ValueError(
                "likelihood_fn: 'adaptive' hypotheses need the log-density of what is "
                "seen; got None"
            )
        if depth < 2 or cell_size is None:
            raise ValueError(
                "hypotheses: 'adaptive' needs a depth of at least 2 and a cell_size; "
                f"got depth {depth} and cell_size {cell_size}"
            )
