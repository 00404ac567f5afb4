"""Which bodies are tied together, be it by way of others: islands.

All arrays are in lanes (`core.lanes`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.physics.joints import Ends, Joints, of_body

PerBody = Float[Array, "body lane"]


class _Link(NamedTuple):
    """Of each slot which bodies it ties, and one where it does, else zero."""

    a: Float[Array, "slot lane"]
    b: Float[Array, "slot lane"]
    on: Float[Array, "slot lane"]


def joint_islands(joints: Joints, mobile: PerBody) -> PerBody | None:
    """A name of each body's island; None where there is a single body.

    Args:
        joints: what ties bodies.
        mobile: one, or zero for a body that is held fast, which ties nothing together.
    """
    num_bodies = mobile.shape[0]
    if num_bodies == 1:
        return None
    joints, mobile = jax.lax.stop_gradient((joints, mobile))
    own = jnp.arange(1, num_bodies + 1, dtype=mobile.dtype)[:, None]
    name = jnp.broadcast_to(own, mobile.shape)
    slots = [
        _Link(ends.a, ends.b, ends.has_b * _both(ends, mobile))
        for ends in (joints.points, joints.rods, joints.angles)
        if ends is not None
    ]
    if not slots:
        return name
    links = _Link(*(jnp.concatenate(parts) for parts in zip(*slots, strict=True)))
    if num_bodies == 2:
        return _spread(links, name)

    def goes_on(carry):
        return carry[1]

    def again(carry):
        new = _spread(links, carry[0])
        return new, jnp.any(new != carry[0])

    return jax.lax.while_loop(goes_on, again, (name, jnp.asarray(True)))[0]


def joined_by_contact(name: PerBody, touches: PerBody) -> PerBody:
    """Islands of which a body touches anything as one.

    Args:
        name: of each body's island.
        touches: share of contact in a body's motion; what is under a half does not
            count, since contacts that are smoothed push a little at any distance.
    """
    is_same = name[:, None] == name[None]
    is_joined = jnp.any(is_same & (touches > 0.5)[None], axis=1)
    return jnp.where(is_joined, 0.0, name)


def over_islands(name: PerBody | None, values: tuple) -> tuple:
    """Of each body what its island has in all.

    Args:
        name: of each body's island; None: there is a single body.
        values: of each body.
    """
    if name is None:
        return values
    is_same = name[:, None] == name[None]
    # Not a product: what is not finite stays on its own island.
    return tuple(
        jnp.sum(jnp.where(is_same, value[None], 0.0), axis=1) for value in values
    )


def _both(ends: Ends, mobile: PerBody) -> Float[Array, "slot lane"]:
    return of_body(ends.a, mobile) * of_body(ends.b, mobile)


def _spread(links: _Link, name: PerBody) -> PerBody:
    """Both bodies of a link get the lesser name."""
    least = jnp.minimum(of_body(links.a, name), of_body(links.b, name))
    beyond = float(name.shape[0] + 1)
    least = jnp.where(links.on > 0.0, least, beyond)[:, None]
    body = jnp.arange(name.shape[0], dtype=name.dtype)[None, :, None]
    is_end = (links.a[:, None] == body) | (links.b[:, None] == body)
    return jnp.minimum(name, jnp.min(jnp.where(is_end, least, beyond), axis=0))
