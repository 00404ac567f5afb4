r"""What is expected of a thing that nobody has touched, from others that look like it.

The predictive law of a Dirichlet process over kinds, with each thing that was tried in
a kind of its own: a new thing is of the kind of thing i, or of a new one, with odds

$$w_i = \frac{p(\text{look} \mid i)}{p(\text{look})}, \qquad w_0 = \alpha,$$

where the look is its label (one draw seen of a symmetric Dirichlet over labels) and the
outline's features (`inference.kinds.features`, normal about those of thing i with the
spread of a kind, against standard normal over all sorts of things). Of a kind that was
tried, hypotheses are draws of that thing's posterior, some apart in density; of a new
one, draws of the prior. It is the collapsed Gibbs step of `infer_kinds` for a thing
without data, with the kinds of the others held, and takes a millisecond; `infer_kinds`
infers those as well, in seconds.
"""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from boomdp_jax.inference.kinds.features import outline_features
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene_spec import SceneSpec

CONCENTRATION = 1.0
"""How readily things are of kinds of their own."""
_LABEL_WEIGHT = 0.1
"""Of the Dirichlet over labels within a kind, on each label."""
_OUTLINE_SPREAD = 0.5
"""Of features within a kind, in units of their spread over all sorts of things."""
_DENSITY_SPREAD = 0.15
"""Of the logarithm of density within a kind."""


def kin_odds(
    spec: SceneSpec, others: Sequence[SceneSpec], num_labels: int
) -> Float[np.ndarray, " other"]:
    """Odds that a thing is of the kind of others, against a new kind's `CONCENTRATION`.

    Args:
        spec: of the thing alone.
        others: of things that were tried.
        num_labels: different labels that things may have.
    """
    own, odds = spec.bodies[0], []
    features = outline_features(own)
    for other in others:
        body = other.bodies[0]
        ratio = 1.0
        if own.label is not None and body.label is not None:
            agrees = own.label == body.label
            within = (agrees + _LABEL_WEIGHT) / (1.0 + num_labels * _LABEL_WEIGHT)
            ratio = within * num_labels
        # Of two draws of a kind, the difference; over all, a draw.
        apart = features - outline_features(body)
        near = _log_normal(apart, np.sqrt(2.0) * _OUTLINE_SPREAD)
        odds.append(ratio * np.exp(near - _log_normal(features, 1.0)))
    return np.array(odds)


def kin_draws(
    rng: np.random.Generator,
    prior: Params,
    others: Sequence[Params],
    odds: Float[np.ndarray, " other"],
) -> Params:
    """Hypotheses about a thing that nobody has touched.

    Args:
        rng: random numbers.
        prior: draws of its prior, leading axis `hypothesis`.
        others: draws of the posteriors of things that were tried.
        odds: of each, `kin_odds`.

    Returns:
        As many draws as of the prior.
    """
    num = prior.density.shape[0]
    weight = np.append(odds, CONCENTRATION)
    weight = weight / weight.sum()
    # Systematically, so that shares are those of the weights.
    place = (np.arange(num) + rng.random()) / num
    source = np.minimum(np.searchsorted(np.cumsum(weight), place), len(others))
    row = rng.integers(0, num, size=num)
    pool = [*others, prior]
    sizes = [one.density.shape[0] for one in pool]
    start = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    picked = start[source] + np.minimum(row, np.array(sizes)[source] - 1)
    every = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *pool)
    draws = jax.tree.map(lambda leaf: leaf[picked], every)
    spread = np.where(source < len(others), _DENSITY_SPREAD, 0.0)
    factor = np.exp(spread * rng.standard_normal(num))
    density = draws.density * jnp.asarray(factor, draws.density.dtype)[:, None]
    return dataclasses.replace(draws, density=density)


def _log_normal(x: np.ndarray, spread: float) -> float:
    return float(np.sum(-0.5 * (x / spread) ** 2 - np.log(spread)))
