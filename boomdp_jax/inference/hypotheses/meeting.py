r"""Pins and rods from where the bodies were seen.

A likelihood takes where a run starts as given. Two bodies that a pin holds have been
seen with its anchors in one place, two on a rod at the rod's length from each other: of
the second anchor, or of the length, that leaves next to nothing open, and a prior as
wide as the scene would charge these joints, and no others, for having stood where they
stood. With the position $x_t$ and the turn $R_t$ of body a in the frame of its partner
(or of the world),

- pin: anchor $r_a$ from the prior, $r_b = \overline{x} + \overline{R} r_a + s \sinh z$,
  means over the readings: each of them has the pin in that place;
- rod: anchors from the prior, length $|x_0 + R_0 r_a - r_b|\,e^{s z}$ of the first
  reading.

The hyperbolic sine leaves room for a first reading that was wrong, and for a pin that
came to be later: twenty times the scale cost seven nats, which would be two hundred
with a normal distribution.

Both anchors of a tie lie near their bodies. On body a that is a normal distribution
about its centre times one about its partner's.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.inference.hypotheses.layout import SlotKey
from boomdp_jax.inference.hypotheses.prior import PriorScales
from boomdp_jax.inference.hypotheses.resting import known_or, poses_against
from boomdp_jax.physics.params import WORLD

_SHORTEST = 1e-3
"""Least length of a rod whose anchors met, in radii: its logarithm is taken."""


def meeting_frame(
    slot: SlotKey, poses: np.ndarray, default: np.ndarray
) -> tuple[float, float, float, float]:
    """Where body a was against its partner, as a linear map of points on it.

    Args:
        slot: of a pin or a rod.
        poses: readings `[reading, body, 3]` [m, m, rad]; NaN where missing.
        default: pose of each body without any reading, `[body, 3]`.

    Returns:
        x, y [m], and c, s of the map $(x, y) + ((c, -s), (s, c)) r$: a rotation for a
        rod, for a pin a mean of some.
    """
    place, angle = poses_against(slot, poses, default)
    if slot.kind == "distance":
        # A mean over one reading is a rotation.
        place, angle = place[:1], angle[:1]
    x, y = place.mean(axis=0)
    cos, sin = np.cos(angle).mean(), np.sin(angle).mean()
    return float(x), float(y), float(cos), float(sin)


def met_at(frame: Float[Array, " 4"], anchor: Float[Array, " 2"]) -> Float[Array, " 2"]:
    """A point of body a in the frame of its partner [m], by `meeting_frame`."""
    x, y, cos, sin = frame
    first, second = anchor
    return jnp.stack([x + cos * first - sin * second, y + sin * first + cos * second])


def rod_length(
    frame: Float[Array, " 4"],
    anchor_a: Float[Array, " 2"],
    anchor_b: Float[Array, " 2"],
    radius: FloatScalar,
) -> Float[Array, ""]:
    """How far apart a rod's anchors were at the first reading [m].

    Args:
        frame: of the slot.
        anchor_a: on body a [m].
        anchor_b: on its partner, or in the world [m].
        radius: of body a's outline [m].
    """
    gap = met_at(frame, anchor_a) - anchor_b
    return jnp.sqrt(jnp.sum(gap**2) + (_SHORTEST * radius) ** 2)


def anchor_scale(
    slot: SlotKey, frame: Float[Array, " 4"], reach: Float[Array, " body"]
) -> tuple[Float[Array, " 2"], Float[Array, ""]]:
    """Mean and unit of a pin's first anchor [m].

    Args:
        slot: of the pin.
        frame: of the slot.
        reach: how far from each body anchors may lie [m].
    """
    own = reach[slot.body_a]
    if slot.body_b == WORLD:
        return jnp.zeros(2), own
    other = reach[slot.body_b]
    x, y, cos, sin = frame
    norm = jnp.sqrt(cos**2 + sin**2) + 1e-12
    partner = -jnp.stack([cos * x + sin * y, cos * y - sin * x]) / norm
    share = own**2 / (own**2 + other**2)
    return share * partner, jnp.sqrt(share) * other


def meeting_numbers(
    slot: SlotKey,
    z: Float[Array, " coordinate"],
    frame: Float[Array, " 4"],
    reach: Float[Array, " body"],
    center: Float[Array, " 2"],
    radius: FloatScalar,
    scales: PriorScales,
    known: dict[str, Float[Array, "..."]],
) -> dict[str, Array]:
    """Anchors of a pin or a rod, and a rod's length.

    Args:
        slot: of the joint.
        z: coordinates of the slot.
        frame: of the slot, as `meeting_frame` has it.
        reach: how far from each body anchors may lie [m].
        center: of body a's path, about which anchors in the world lie [m].
        radius: of body a's outline [m].
        scales: of the prior.
        known: numbers that a scene gives; NaN where they are to be inferred.

    Returns:
        The numbers, with anchors that are known in their places.
    """

    def scaled(name: str, at):
        return scales.scaled(f"{slot.kind}.{name}", at)

    def given(name: str, value):
        return known_or(known, name, value)

    if slot.kind == "revolute":
        middle, unit = anchor_scale(slot, frame, reach)
        first = given("anchor_a", middle + unit * scaled("anchor", z[0:2]))
        off = radius * scaled("offset", jnp.sinh(z[2:4]))
        return {"anchor_a": first, "anchor_b": met_at(frame, first) + off}
    is_world = slot.body_b == WORLD
    own = reach[slot.body_a]
    origin, unit = (center, own) if is_world else (jnp.zeros(2), reach[slot.body_b])
    first = given("anchor_a", own * scaled("anchor", z[0:2]))
    second = given("anchor_b", origin + unit * scaled("anchor", z[2:4]))
    length = rod_length(frame, first, second, radius) * jnp.exp(scaled("length", z[4]))
    return {"anchor_a": first, "anchor_b": second, "length": length}
