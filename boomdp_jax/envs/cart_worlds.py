"""What may be true of the cart instead of what its agent is told.

An agent knows the outline that it is told, that forces push the centre of mass, and
that wheels, if there are any, are viscous; whatever else holds it may find. In each of
these worlds one of that is wrong, and nothing in the agent's scene can say so:

- `dry`: wheels and floor rub as dry bodies do. The wheels roll at a constant force and
  give way across at three times what the cart is pushed with; the floor takes a share
  of the weight. The cart has no speed of its own then: it stops, or it gathers way.
- `off-centre`: goods lie ahead and on one side, so that the centre of mass is not the
  centroid, at which forces push all the same and which readings tell of. Inertia about
  the centre of mass is as it was.
- `caster`: a third wheel at the front that swivels. Its trail is taken to be short next
  to the way of a step, so that it points where its mount goes at once: what is left of
  it is a force of constant size against the velocity of its mount, whichever way that
  is. The angle of a caster with a long trail would be hidden state; this one has none.
- `large`: the agent is told an outline 15 % too long and too wide.
- `box`: the agent is told a box of the cart's length and mean width, not the taper.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from boomdp_jax.physics.shapes import polygon_moments

VISCOUS = (30.0, 600.0)
"""Of the papers' wheels: force per speed, rolling and across [N s/m]."""
DRY_WHEEL, DRY_FLOOR = (8.0, 90.0), 0.15
"""Of the dry world: forces of the wheels [N], friction coefficient of the floor."""
OFF_CENTRE = (0.25, -0.1)
"""Of the centre of mass, in the frame of the centroid [m]."""
CASTER_PLACE, CASTER_DRY = (0.55, 0.0), 8.0
"""In the frame of the outline [m]; force against its way [N]."""
TOO_LARGE = 1.15
"""Told over true length and width."""

Corners = tuple[tuple[float, float], ...]


class CartWorld(NamedTuple):
    """What differs from what an agent is told."""

    wheel: Mapping[str, Any] = MappingProxyType({"viscous": list(VISCOUS)})
    """Friction of the two fixed wheels, as a scene says it."""
    more: tuple[Mapping[str, Any], ...] = ()
    """Constraints besides these."""
    center_of_mass: tuple[float, float] | None = None
    """From the centroid [m]; None: there."""
    num_parts: int = 1
    """In which the engine takes a step of the world."""
    scale: float = 1.0
    """Of the outline as told, about its centroid."""
    is_box: bool = False
    """Whether a box is told."""

    def told(self, outline: Corners) -> Corners:
        """The outline as agents are told it, about the true one's centroid.

        Args:
            outline: the true one, counter-clockwise [m].

        Returns:
            Corners [m]; the very same if nothing is wrong with them.
        """
        corners = np.array(outline)
        if self.is_box:
            corners = _box_of(corners)
        if self.scale != 1.0:
            middle = polygon_moments(corners).centroid
            corners = middle + self.scale * (corners - middle)
        return tuple((float(x), float(y)) for x, y in corners)


def _box_of(corners: Float[np.ndarray, "vertex 2"]) -> Float[np.ndarray, "vertex 2"]:
    """The box along the axes with the same length and area, about the centroid."""
    moments = polygon_moments(corners)
    length = float(np.ptp(corners[:, 0]))
    half = 0.5 * np.array([length, moments.area / length])
    signs = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return moments.centroid + signs * half


CART_WORLDS: Mapping[str, CartWorld] = MappingProxyType(
    {
        "as-told": CartWorld(),
        "dry": CartWorld(
            wheel={"dry": list(DRY_WHEEL)},
            more=({"type": "ground", "a": "cart", "dry": DRY_FLOOR},),
        ),
        "off-centre": CartWorld(center_of_mass=OFF_CENTRE),
        "caster": CartWorld(
            more=(
                {
                    "type": "wheel",
                    "a": "cart",
                    "pose": [*CASTER_PLACE, 0.0],
                    "dry": [CASTER_DRY, CASTER_DRY],
                },
            ),
            # One contact's law the engine integrates exactly, viscous and dry together
            # to first order: a step as a whole, the caster drags a third of its force.
            num_parts=8,
        ),
        "large": CartWorld(scale=TOO_LARGE),
        "box": CartWorld(is_box=True),
    }
)
"""By name; in the first all is as agents are told."""


def cart_world_of(name: str) -> CartWorld:
    """A world by its name.

    Raises:
        ValueError: it is none of `CART_WORLDS`.
    """
    if name not in CART_WORLDS:
        raise ValueError(
            f"world: expected one of {', '.join(CART_WORLDS)}; got {name!r}"
        )
    return CART_WORLDS[name]
