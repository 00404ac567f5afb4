"""What values under several hypotheses are worth together.

- `"mean"`;
- `"cvar"`: the mean over the worst part of the belief, `risk_level` of its weight
  (Rockafellar and Uryasev 2000, Optimization of conditional value-at-risk);
- `"worst"`: the least, over hypotheses that are not ruled out.
"""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import IntScalar

RISK_MEASURES = ("mean", "cvar", "worst")

_TRIFLE = 1e-4


def combine(
    values: Float[Array, "hypothesis action"],
    weight: Float[Array, " hypothesis"],
    *,
    measure: str,
    level: Any,
) -> Float[Array, " action"]:
    """One value for each action.

    Args:
        values: finite.
        weight: sums to one.
        measure: one of `RISK_MEASURES`.
        level: part of the weight that `"cvar"` averages over, in (0, 1].

    Returns:
        The values.
    """
    if measure == "mean":
        return jnp.sum(weight[:, None] * values, axis=0)
    if measure == "worst":
        return jnp.min(jnp.where(weight[:, None] > 0, values, jnp.inf), axis=0)
    order = jnp.argsort(values, axis=0)
    ordered = jnp.take_along_axis(values, order, axis=0)
    before = jnp.cumsum(weight[order], axis=0) - weight[order]
    part = jnp.clip(level - before, 0.0, weight[order])
    return jnp.sum(part * ordered, axis=0) / level


def choose(
    values: Float[Array, "hypothesis action"],
    weight: Float[Array, " hypothesis"],
    *,
    measure: str,
    level: Any,
) -> tuple[IntScalar, Float[Array, " action"]]:
    """The best action, and one value for each.

    Where nothing is known under a hypothesis that has weight, no action has a value;
    the choice is then by the other hypotheses.

    Args:
        values: of a hypothesis all finite, or all −∞ where nothing is known.
        weight: sums to one.
        measure: one of `RISK_MEASURES`.
        level: part of the weight that `"cvar"` averages over, in (0, 1].

    Returns:
        Its index, and the values; −∞ where there is none.
    """
    is_known = jnp.all(values > -jnp.inf, axis=1)
    known_weight = jnp.where(is_known, weight, 0.0)
    total = jnp.sum(known_weight)
    is_whole = jnp.all(is_known | (weight == 0))
    # To the last bit as it was where nothing is missing, and no 0 / 0 where all is.
    used = jnp.where(is_whole | (total == 0), weight, known_weight / total)
    finite = jnp.where(is_known[:, None], values, 0.0)
    combined = combine(finite, used, measure=measure, level=level)
    return jnp.argmax(combined), jnp.where(is_whole, combined, -jnp.inf)


def without_unknown(
    values: Float[Array, "*batch action"],
) -> Float[Array, "*batch action"]:
    """Actions of unknown value get the worst that is known under their hypothesis.

    All that follows them was dropped; −∞ would veto them under every other hypothesis.
    They get a trifle less, so that where one action alone is known it is chosen. Where
    none is known all stay at −∞: there is nothing to make a value of.
    """
    is_known = values > -jnp.inf
    worst = jnp.min(jnp.where(is_known, values, jnp.inf), axis=-1, keepdims=True)
    is_any_known = jnp.isfinite(worst)
    worst = jnp.where(is_any_known, worst, 0.0)
    stand_in = worst - _TRIFLE * (1.0 + jnp.abs(worst))
    return jnp.where(is_known, values, jnp.where(is_any_known, stand_in, -jnp.inf))
