"""How a body stands on the floor, as far as the scene does not tell."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.inference.hypotheses.prior import PriorScales
from boomdp_jax.physics.scene import Scene


def stance_numbers(
    scales: PriorScales, scene: Scene, body: int, z: Float[Array, "4"]
) -> dict[str, Float[Array, "..."]]:
    """Feet from an even pressure to four legs of any height, from coordinates.

    Where a scene gives a body's feet, only their loads may be others: four legs are
    seldom equally long. Feet that it does not give have a size, by which they are known
    (`shapes.support_feet`).

    Args:
        scales: of the prior.
        scene: of a block.
        body: which of its bodies.
        z: of the scale along both axes, of the corners' share and of a diagonal's.

    Returns:
        `Ground.stance_scale`, `corner_share` and `diagonal_share` of the body.
    """
    size, diagonal = scene.foot_size, scene.diagonal
    is_open = jnp.asarray(False) if size is None else jnp.any(size[body] > 0.0)
    rocks = jnp.asarray(False) if diagonal is None else jnp.any(diagonal[body] != 0.0)
    scale = jnp.exp(scales.scaled("ground.stance_scale", z[:2]))
    corner = jax.nn.sigmoid(scales.scaled("ground.corner_share", z[2]))
    share = jax.nn.sigmoid(scales.scaled("ground.diagonal_share", z[3]))
    return {
        "stance_scale": jnp.where(is_open, scale, 1.0),
        "corner_share": jnp.where(is_open, corner, 0.0),
        "diagonal_share": jnp.where(rocks, share, 0.5),
    }
