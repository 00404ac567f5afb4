"""Which one draw to take where it has to be one."""

from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.physics import Params
from boomdp_jax.physics.params import WORLD


@eqx.filter_jit
def ranking(
    params: Params,
    inferred: Mapping[str, Bool[np.ndarray, "..."]],
    weights: Float[Array, " draw"],
    log_density: Float[Array, " draw"],
) -> Float[Array, " draw"]:
    """Log-densities of the draws of the most probable structure, the others at −∞.

    Densities of structures with other numbers of coordinates do not compare, and draws
    of a sampler all weigh the same, so that neither alone tells which one is likeliest.

    Args:
        params: draws, with a leading axis.
        inferred: by kind, which slots are inferred rather than known.
        weights: of the draws, not necessarily normalised.
        log_density: of the draws.

    Returns:
        The largest is that of the hypothesis to take, if it has to be one.
    """
    codes = _codes(params, inferred)
    same = jnp.all(codes[:, None] == codes[None], axis=-1)
    probability = jnp.sum(jnp.where(same, weights[None], 0.0), axis=1)
    # Rounding must not tell draws of one structure apart.
    is_likeliest = same[jnp.argmax(probability)]
    is_there = is_likeliest & (weights > 0) & ~jnp.isnan(log_density)
    return jnp.where(is_there, log_density, -jnp.inf)


def _codes(params: Params, inferred: Mapping) -> Int[Array, "draw code"]:
    """Equal where structures are, whichever slots they are in."""
    num_draws, num_bodies = params.density.shape
    codes = [jnp.zeros((num_draws, 1), int)]
    for kind, is_inferred in inferred.items():
        group = getattr(params, kind)
        if group is None or not np.size(is_inferred):
            continue
        active = group.active & jnp.asarray(is_inferred)[None]
        if is_inferred.ndim == 2:
            codes.append(active.sum(axis=2))
            continue
        ends = [
            jnp.where(e == WORLD, num_bodies, e) for e in (group.body_a, group.body_b)
        ]
        tie = jnp.minimum(*ends) * (num_bodies + 1) + jnp.maximum(*ends)
        codes.append(jnp.sort(jnp.where(active, tie, -1), axis=1))
    return jnp.concatenate(codes, axis=1)
