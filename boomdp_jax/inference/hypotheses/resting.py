r"""Drawers and welds by as many coordinates as there are different ones.

Both hold a body's angle, a drawer keeps its centre of mass on a line, a weld at a
point. With the mean pose $(x_0, \theta_0)$ that was seen and the direction $\phi_0$ in
which positions spread most (all against the partner), n across the axis,

- drawer: axis $\phi_0 + z_0$, line through $x_0 + n s \sinh z_1$, angle
  $\theta_0 + s' \sinh z_2$;
- weld: place $x_0 + s\,(\sinh z_0, \sinh z_1)$, angle $\theta_0 + s' \sinh z_2$

(the hyperbolic sine for the reason given in `meeting`).

The axis's range is cut across $\phi_0$, where no drawer that has moved lies: on the cut
a line's distance would change its sign. Which of its points are the anchors is free;
they are the body's centre of mass and where that is at $\phi_0$, except where a scene
gives one.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.inference.hypotheses.layout import SlotKey
from boomdp_jax.inference.hypotheses.prior import PriorScales
from boomdp_jax.physics.params import WORLD


def poses_against(
    slot: SlotKey, poses: np.ndarray, default: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where a slot's body was in the frame of its partner, or of the world.

    Args:
        slot: of any joint.
        poses: readings `[reading, body, 3]` [m, m, rad]; NaN where missing.
        default: pose of each body without any reading, `[body, 3]`.

    Returns:
        Places `[seen, 2]` [m] and angles `[seen]` [rad] at the readings that are whole,
        one at least.
    """
    columns = [slot.body_a] + ([] if slot.body_b == WORLD else [slot.body_b])
    seen = poses[:, columns]
    seen = seen[np.all(np.isfinite(seen), axis=(1, 2))]
    if len(seen) == 0:
        seen = default[None, columns]
    place, angle = seen[:, 0, :2], seen[:, 0, 2]
    if slot.body_b != WORLD:
        x, y = (place - seen[:, 1, :2]).T
        cos, sin = np.cos(seen[:, 1, 2]), np.sin(seen[:, 1, 2])
        place = np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)
        angle = angle - seen[:, 1, 2]
    return place, angle


def rest_pose(
    slot: SlotKey, poses: np.ndarray, default: np.ndarray
) -> tuple[float, float, float, float]:
    """Mean pose of a slot's body against its partner, and the way it moved most.

    Angles are counted in turns of the first reading: the mean is over what is left of
    each when whole turns are taken off.

    Args:
        slot: of a drawer or a weld.
        poses: readings `[reading, body, 3]` [m, m, rad]; NaN where missing.
        default: pose of each body without any reading, `[body, 3]`.

    Returns:
        x, y [m] and angle [rad] of body `a` in the frame of `b` or of the world, and
        the direction there in which positions spread most [rad].
    """
    place, angle = poses_against(slot, poses, default)
    off = angle - angle[0]
    middle = place.mean(0)
    (xx, xy), (_, yy) = (place - middle).T @ (place - middle)
    return (
        float(middle[0]),
        float(middle[1]),
        float(angle[0] + np.mean(off - 2.0 * np.pi * np.round(off / (2.0 * np.pi)))),
        float(0.5 * np.arctan2(2.0 * xy, xx - yy)),
    )


def known_or(
    known: dict[str, Float[Array, "..."]], name: str, value: Float[Array, "..."]
) -> Float[Array, "..."]:
    """What a scene gives of a number, and the rest of it from `value`."""
    number = known.get(name, jnp.full_like(value, jnp.nan))
    return jnp.where(jnp.isnan(number), value, number)


def rest_numbers(
    kind: str,
    z: Float[Array, " coordinate"],
    rest: Float[Array, " 4"],
    radius: FloatScalar,
    scales: PriorScales,
    known: dict[str, Float[Array, "..."]],
) -> dict[str, Array]:
    """Anchors and angle of a drawer or weld, and a drawer's axis.

    Args:
        kind: `prismatic` or `weld`.
        z: coordinates of the slot.
        rest: of the slot, as `rest_pose` has it.
        radius: unit of distances [m].
        scales: of the prior.
        known: numbers that a scene gives; NaN where they are to be inferred.

    Returns:
        The numbers, with those that are known in their places.
    """

    def scaled(name: str, at):
        return scales.scaled(f"{kind}.{name}", at)

    def given(name: str, value):
        return known_or(known, name, value)

    numbers = {"angle": given("angle", rest[2] + scaled("angle", jnp.sinh(z[2])))}
    if kind == "prismatic":
        axis = given("axis", rest[3] + z[0])
        numbers["axis"] = axis
        across = jnp.stack([-jnp.sin(axis), jnp.cos(axis)])
        place = rest[:2] + radius * scaled("offset", jnp.sinh(z[1])) * across
    else:
        place = rest[:2] + radius * scaled("offset", jnp.sinh(z[0:2]))
    cos, sin = jnp.cos(numbers["angle"]), jnp.sin(numbers["angle"])
    # Where a scene gives the partner's anchor alone, the body's follows from it.
    x, y = given("anchor_b", place) - place
    is_fixed = ~jnp.any(jnp.isnan(known.get("anchor_b", jnp.full(2, jnp.nan))))
    anchor = jnp.stack([cos * x + sin * y, cos * y - sin * x])
    x, y = anchor = given("anchor_a", jnp.where(is_fixed, anchor, 0.0))
    turned = jnp.stack([cos * x - sin * y, sin * x + cos * y])
    return {
        **numbers,
        "anchor_a": anchor,
        "anchor_b": given("anchor_b", place + turned),
    }
