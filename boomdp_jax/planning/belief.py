"""What a planner knows of the world: weighted hypotheses.

Planners take a belief in one of three forms: a `Belief`; a pair of a pytree with a
leading hypothesis axis and log-weights; or anything with `params` and `log_weight`,
as a posterior has.
"""

from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from boomdp_jax.core.arrays import IntScalar, Key
from boomdp_jax.core.full_precision import full_precision


class Belief(eqx.Module):
    """Weighted hypotheses."""

    hypotheses: PyTree
    """What the model takes as its hypothesis, with a leading axis `hypothesis`."""
    log_weight: Float[Array, " hypothesis"]
    """Not necessarily normalised; −∞ for what is ruled out."""
    log_density: Float[Array, " hypothesis"] | None = None
    """By which one is the most probable, where weights do not tell: draws of a sampler
    all weigh the same. None: by `log_weight`."""

    @property
    def num_hypotheses(self) -> int:
        """Length of the axis `hypothesis`."""
        return self.log_weight.shape[0]

    @property
    def weight(self) -> Float[Array, " hypothesis"]:
        """Normalised to a sum of one."""
        return jax.nn.softmax(self.log_weight)

    @property
    def likeliest(self) -> IntScalar:
        """Index of the most probable hypothesis."""
        if self.log_density is None:
            return jnp.argmax(self.log_weight)
        return jnp.argmax(
            jnp.where(self.log_weight > -jnp.inf, self.log_density, -jnp.inf)
        )

    def __getitem__(self, index: Any) -> PyTree:
        """The hypothesis at an index, or those at several."""
        return jax.tree.map(lambda leaf: leaf[index], self.hypotheses)


def as_belief(belief: Any, *, is_ranked: bool = False) -> Belief:
    """Read a belief in any of its forms.

    Args:
        belief: a `Belief`, a pair `(hypotheses, log_weight)`, or an object with
            `params` and `log_weight`.
        is_ranked: whether such an object is asked which of its draws is the most
            probable one, by its method `ranking`, where it has one.

    Returns:
        The same as a `Belief`.

    Raises:
        TypeError: none of these.
        ValueError: no hypothesis, another number of hypotheses than of weights, or
            log-weights of which none is finite, or one NaN or +∞.
    """
    log_density = None
    if isinstance(belief, Belief):
        hypotheses, log_weight = belief.hypotheses, belief.log_weight
        log_density = belief.log_density
    elif hasattr(belief, "params") and hasattr(belief, "log_weight"):
        hypotheses, log_weight = belief.params, belief.log_weight
        if is_ranked and hasattr(belief, "ranking"):
            log_density = jnp.asarray(belief.ranking(), float)
    elif isinstance(belief, tuple) and len(belief) == 2:
        hypotheses, log_weight = belief
    else:
        raise TypeError(
            "belief: expected a Belief, a pair (hypotheses, log_weight) or a "
            f"posterior; got {type(belief).__name__}"
        )
    log_weight = jnp.asarray(log_weight, float)
    if log_weight.ndim != 1 or not log_weight.shape[0]:
        raise ValueError(
            "belief: log_weight has one number for each hypothesis; got shape "
            f"{log_weight.shape}"
        )
    _check_weights(log_weight)
    for path, leaf in jax.tree_util.tree_leaves_with_path(hypotheses):
        if jnp.shape(leaf)[:1] != log_weight.shape:
            name = jax.tree_util.keystr(path) or "of hypotheses"
            raise ValueError(
                f"belief: leaf {name} has shape {jnp.shape(leaf)}; expected a leading "
                f"axis of {log_weight.shape[0]} hypotheses, as many as weights"
            )
    return Belief(jax.tree.map(jnp.asarray, hypotheses), log_weight, log_density)


def _check_weights(log_weight: Float[Array, " hypothesis"]) -> None:
    """Raise unless they can be normalised, where they are known yet."""
    if isinstance(log_weight, jax.core.Tracer):
        return
    values = np.asarray(log_weight)
    if np.any(np.isnan(values) | (values == np.inf)) or np.all(values == -np.inf):
        raise ValueError(
            "belief: log_weight: expected numbers below infinity, at least one of them "
            f"finite; got {np.array2string(values, threshold=12)}"
        )


def certain(hypothesis: PyTree) -> Belief:
    """The belief of one who knows.

    Args:
        hypothesis: what is true, without the axis `hypothesis`.

    Returns:
        A belief of one hypothesis.
    """
    return Belief(
        jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], hypothesis), jnp.zeros(1)
    )


def resample(key: Key, belief: Belief, num: int) -> Belief:
    """As many hypotheses of equal weight, drawn systematically.

    A belief with no more hypotheses than that stays as it is, with its weights.

    Args:
        key: random key.
        belief: what to draw from.
        num: how many to draw.

    Returns:
        Hypotheses; each occurs as often as its weight says, rounded down or up.
    """
    if belief.num_hypotheses <= num:
        return belief
    index = systematic(key, belief.weight, num)
    density = None if belief.log_density is None else belief.log_density[index]
    return Belief(belief[index], jnp.zeros(num), density)


def systematic(
    key: Key, weight: Float[Array, " hypothesis"], num: int
) -> Int[Array, " draw"]:
    """Indices by one uniform number and equal steps through the cumulated weights."""
    points = (jax.random.uniform(key) + jnp.arange(num)) / num
    index = jnp.searchsorted(jnp.cumsum(weight), points)
    return jnp.minimum(index, weight.shape[0] - 1)


def most_probable(belief: Belief) -> Belief:
    """Only the most probable hypothesis."""
    return certain(belief[belief.likeliest])


@full_precision
def mean_hypothesis(belief: Belief) -> Belief:
    """Weighted means of all numbers, of those like the most probable hypothesis.

    Like it are those that agree in all that is not a float, as in which constraints
    exist: the same number means something else where they do not. Angles are averaged
    as numbers.
    """
    best = belief[belief.likeliest]
    weight = belief.weight
    for leaf, value in zip(
        *map(jax.tree.leaves, (belief.hypotheses, best)), strict=True
    ):
        if not jnp.issubdtype(leaf.dtype, jnp.inexact):
            is_like = jnp.all(jnp.reshape(leaf == value[None], (len(leaf), -1)), axis=1)
            weight = jnp.where(is_like, weight, 0.0)
    weight = weight / weight.sum()

    def mean(leaf, best):
        if not jnp.issubdtype(leaf.dtype, jnp.inexact):
            return best
        counts = jnp.reshape(weight > 0, (-1, *[1] * best.ndim))
        # Infinite where there is no limit, also in hypotheses that do not count.
        known = jnp.where(counts, leaf, 0.0)
        return jnp.tensordot(weight.astype(leaf.dtype), known, axes=1)

    return certain(jax.tree.map(mean, belief.hypotheses, best))


def draw_index(key: Key, belief: Belief) -> IntScalar:
    """Of one hypothesis, by weight."""
    return jax.random.categorical(key, belief.log_weight)
