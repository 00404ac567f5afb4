r"""Impacts give nothing that they did not get.

Newton's restitution, a ratio of speeds along the normal, may create energy where there
is friction (Stronge 1990, Proc. R. Soc. A 431, 169), and so may impacts one after the
other where several bodies meet at once. Of 57,828 random worlds in contact two gained
one and five per cent of theirs, both with a body that turned by radians in a substep.

With v the twists without contact, d what contact does to them, and M the masses,
$T(\alpha) = \frac12 (v + \alpha d)^T M (v + \alpha d)$. Of d the share
$\alpha \le 1$ is left at which T is what it was before contact. That changes no
momentum, since d is made of impulses between bodies. Surfaces part more slowly then;
where they do not part, which takes bodies that turn a radian in a substep, the next
substep finds them again.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.physics.contact_rows import Ease

# What an impact may add of the energy of a world: no more than rounding and sweeps that
# have not quite found their end.
_MOST_GAIN = 1e-4

Twist = tuple[Float[Array, "body lane"], ...]


def without_gain(ease: Ease, began: Twist, free: Twist, after: Twist) -> Twist:
    """Twists after an impact that adds no energy.

    Args:
        ease: of every body, without mixed terms.
        began: twists as the substep began.
        free: as they would be at its end without contact; the larger energy of both is
            what there is.
        after: with contact.

    Returns:
        Those with contact, or so much nearer to those without as it takes.
    """
    masses = [
        jnp.where(e > 0.0, 1.0 / jnp.where(e > 0.0, e, 1.0), 0.0) for e in ease[:3]
    ]

    def product(first: Twist, second: Twist) -> Float[Array, " lane"]:
        x, y, spin = (m * v * w for m, v, w in zip(masses, first, second, strict=True))
        return jnp.sum(x + y + spin, axis=0)

    change = tuple(new - old for new, old in zip(after, free, strict=True))
    start, slope = product(free, free), 2.0 * product(free, change)
    square = product(change, change)
    most = jnp.maximum(start, product(began, began))
    is_gain = start + slope + square > (1.0 + _MOST_GAIN) * most
    # The larger root of a parabola through no more than `most` at zero. No derivative
    # of the root of nothing, and none where nothing is gained.
    under = slope * slope + 4.0 * square * (most - start)
    has_root = is_gain & (under > 0.0)
    root = jnp.where(has_root, jnp.sqrt(jnp.where(has_root, under, 1.0)), 0.0)
    share = (root - slope) / jnp.where(is_gain, 2.0 * square, 1.0)
    share = jnp.maximum(share, 0.0)[None]
    return tuple(
        jnp.where(is_gain[None], v + share * dv, new)
        for v, dv, new in zip(free, change, after, strict=True)
    )
