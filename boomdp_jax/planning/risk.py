"""What values under several hypotheses are worth together.

- `"mean"`;
- `"cvar"`: the mean over the worst part of the belief, `risk_level` of its weight
  (Rockafellar and Uryasev 2000, Optimization of conditional value-at-risk);
- `"worst"`: the least, over hypotheses that are not ruled out.
"""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

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


def without_unknown(
    values: Float[Array, "*batch action"],
) -> Float[Array, "*batch action"]:
    """Actions of unknown value get the worst that is known under their hypothesis.

    All that follows them was dropped; −∞ would veto them under every other hypothesis.
    They get a trifle less, so that where one action alone is known it is chosen.
    """
    is_known = values > -jnp.inf
    worst = jnp.min(jnp.where(is_known, values, jnp.inf), axis=-1, keepdims=True)
    worst = jnp.where(jnp.isfinite(worst), worst, 0.0)
    return jnp.where(is_known, values, worst - _TRIFLE * (1.0 + jnp.abs(worst)))
