"""Which numbers of a block are sampled under which name, with which distribution.

The distributions are those of `coordinates.py`, stated on physical numbers: one site is
an affine map of a few standard-normal coordinates, or its exponential or logistic.
Coefficients are sampled relative to mass and weight, as there.
"""

import math
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax.scipy.special import logit
from jaxtyping import Array, Float
from numpyro.distributions import constraints, transforms

from boomdp_jax.inference.blocks.block import Block
from boomdp_jax.inference.hypotheses.body_numbers import number_scale
from boomdp_jax.inference.hypotheses.layout import (
    BODY_NUMBERS,
    BodyNumber,
    Layout,
    SlotKey,
)
from boomdp_jax.inference.hypotheses.meeting import anchor_scale
from boomdp_jax.inference.hypotheses.prior import LOGARITHMIC
from boomdp_jax.inference.hypotheses.slot_names import slot_names
from boomdp_jax.physics.params import WORLD

Link = Literal["identity", "log", "logit", "half_turn", "arcsinh"]


class Site(NamedTuple):
    """One sample site; its `coordinates` are (link(value) - loc) / scale.

    A direction's is brought to half a turn about zero. With `arcsinh` the link comes
    last: arcsinh((value - loc) / scale).
    """

    name: str
    coordinates: tuple[int, ...]
    """Places in the block's coordinates; one for a scalar."""
    link: Link
    loc: Array
    scale: Array

    @property
    def prior(self) -> dist.Distribution:
        """Distribution of the value."""
        if self.link == "half_turn":
            return HalfTurn()
        if self.link == "log":
            return dist.LogNormal(self.loc, self.scale)
        if self.link == "arcsinh":
            spread: Any = dist.Normal(jnp.zeros_like(self.loc), 1.0)
            steps = [Sinh(), transforms.AffineTransform(self.loc, self.scale)]
            return dist.TransformedDistribution(spread, steps).to_event(self.loc.ndim)
        normal: Any = dist.Normal(self.loc, self.scale)
        if self.link == "logit":
            return dist.TransformedDistribution(normal, transforms.SigmoidTransform())
        return normal.to_event(self.loc.ndim)

    def to_coordinates(self, value: Array) -> Float[Array, " coordinate"]:
        """Coordinates of a value."""
        linked = value
        if self.link == "log":
            linked = jnp.log(value)
        elif self.link == "logit":
            linked = logit(value)
        elif self.link == "half_turn":
            turned = value - self.loc
            linked = value - math.pi * jnp.floor(turned / math.pi + 0.5)
        z = (linked - self.loc) / self.scale
        return jnp.reshape(jnp.arcsinh(z) if self.link == "arcsinh" else z, -1)

    def from_coordinates(self, z: Float[Array, " dim"]) -> Array:
        """The value at coordinates of the whole block."""
        own = jnp.reshape(z[jnp.asarray(self.coordinates)], self.loc.shape)
        if self.link == "arcsinh":
            own = jnp.sinh(own)
        linked = self.loc + self.scale * own
        if self.link == "log":
            return jnp.exp(linked)
        return jax.nn.sigmoid(linked) if self.link == "logit" else linked


class Sinh(transforms.ParameterFreeTransform):
    """Hyperbolic sine."""

    domain = constraints.real
    codomain = constraints.real

    def __call__(self, x: Array) -> Array:
        """The value at x."""
        return jnp.sinh(x)

    def _inverse(self, y: Array) -> Array:
        return jnp.arcsinh(y)

    def log_abs_det_jacobian(
        self, x: Array, y: Array, intermediates: Any = None
    ) -> Array:
        """Logarithm of cosh x."""
        return jnp.logaddexp(x, -x) - math.log(2.0)


class HalfTurn(dist.Distribution):
    r"""Uniform over directions that are the same when turned by half a turn [rad].

    Draws lie in $[-\pi/2, \pi/2)$. Every real number is a heading, with density $1/\pi$
    wherever it lies, so that a sampler moves on without meeting an edge; its draws are
    to be read modulo $\pi$. An interval with ends would cut a mode near them in two.
    """

    arg_constraints: dict = {}  # noqa: RUF012 as NumPyro declares it
    support = constraints.real

    def __init__(self):
        super().__init__(batch_shape=(), event_shape=())

    def sample(self, key: Any, sample_shape: tuple[int, ...] = ()) -> Array:
        """Draw headings."""
        uniform = jax.random.uniform(key, sample_shape)
        return math.pi * (uniform - 0.5)

    def log_prob(self, value: Any, intermediates: Any = None) -> Array:
        """Log-density, the same everywhere."""
        return jnp.full(jnp.shape(value), -math.log(math.pi))


# Name of each number, its entry in the prior, first coordinate within the slot, count.
_NUMBERS: dict[str, tuple[tuple[str, str, int, int], ...]] = {
    "revolute": (
        ("anchor_a", "revolute.anchor", 0, 2),
        ("offset", "revolute.offset", 2, 2),
        ("viscous_rate", "revolute.viscous_rate", 4, 1),
        ("dry_share", "revolute.dry_share", 5, 1),
    ),
    "distance": (
        ("anchor_a", "distance.anchor", 0, 2),
        ("anchor_b", "distance.anchor", 2, 2),
        ("length_ratio", "distance.length", 4, 1),
    ),
    "prismatic": (
        ("axis", "", 0, 1),
        ("offset", "prismatic.offset", 1, 1),
        ("angle", "prismatic.angle", 2, 1),
        ("viscous_rate", "prismatic.viscous_rate", 3, 1),
        ("dry_share", "prismatic.dry_share", 4, 1),
    ),
    "weld": (
        ("offset", "weld.offset", 0, 2),
        ("angle", "weld.angle", 2, 1),
    ),
    "wheel": (
        ("position", "wheel.position", 0, 2),
        ("heading", "", 2, 1),
        ("lateral_rate", "wheel.lateral_rate", 3, 1),
        ("lateral_limit", "wheel.lateral_limit", 4, 1),
        ("viscous_ratio", "wheel.viscous_ratio", 5, 1),
        ("dry_ratio", "wheel.dry_ratio", 6, 1),
        ("half_track", "wheel.half_track", 7, 1),
    ),
    "ground": (
        ("dry", "ground.friction", 0, 1),
        ("knee_speed", "ground.knee_speed", 1, 1),
        ("torque_share", "ground.torque_share", 2, 1),
        ("load_shift", "ground.load_shift", 3, 2),
        ("stance_scale", "ground.stance_scale", 5, 2),
        ("corner_share", "ground.corner_share", 7, 1),
        ("diagonal_share", "ground.diagonal_share", 8, 1),
    ),
}
_LOGISTIC = (
    "wheel.viscous_ratio",
    "wheel.dry_ratio",
    "ground.torque_share",
    "ground.corner_share",
    "ground.diagonal_share",
)
_WITH_TAILS = (
    "revolute.offset",
    "prismatic.offset",
    "prismatic.angle",
    "weld.offset",
    "weld.angle",
)


def block_sites(block: Block, names: tuple[str, ...]) -> tuple[Site, ...]:
    """Sample sites of a block in its one structure.

    A number that the scene gives has no site; of a pair of which it gives one, the
    other is a site of its own, `anchor_a[1]`.

    Args:
        block: as `structure_blocks` makes it.
        names: of its bodies.

    Returns:
        Sites; every coordinate on which the hypothesis depends belongs to one.
    """
    likelihood: Any = block.target.log_likelihood
    scales = likelihood.coordinates.scales
    is_free = _free_coordinates(likelihood.coordinates)
    sites = [
        Site(
            f"{name}.density",
            (index,),
            "log",
            scales.center["density"],
            scales.spread["density"],
        )
        for index, name in enumerate(names)
    ]
    sites += [
        _body_site(number, names[number.body], likelihood.coordinates)
        for number in block.layout.numbers
    ]
    for slot, name in slot_names(names, block.layout).items():
        sites += _slot_sites(slot, name, likelihood.coordinates)
    for name in block.layout.contact:
        entry = f"contact.{name}"
        center, spread = scales.center[entry], scales.spread[entry]
        link = "log" if entry in LOGARITHMIC else "logit"
        place = block.layout.contact_coordinate(name)
        sites.append(Site(entry, (place,), link, center, spread))
    kept = []
    for site in sites:
        free = [place for place, c in enumerate(site.coordinates) if is_free[c]]
        if len(free) == len(site.coordinates):
            kept.append(site)
        else:
            kept += [
                Site(
                    f"{site.name}[{place}]",
                    (site.coordinates[place],),
                    site.link,
                    site.loc[place],
                    site.scale[place],
                )
                for place in free
            ]
    return tuple(kept)


def coordinate_names(names: tuple[str, ...], layout: Layout) -> list[str]:
    """Which number each coordinate of a block stands for.

    Args:
        names: of its bodies.
        layout: of its coordinates.

    Returns:
        Names as sample sites have them, `table.ground.knee_speed`, with a place where
        there are several coordinates to a number, `table.revolute.anchor_a[1]`.
    """
    found = [f"{name}.density" for name in names] + [""] * (layout.dim - len(names))

    def put(name: str, start: int, count: int) -> None:
        for place in range(count):
            found[start + place] = f"{name}[{place}]" if count > 1 else name

    for slot, name in slot_names(names, layout).items():
        for field, _, first, count in _NUMBERS[slot.kind]:
            put(f"{name}.{field}", slot.start + first, count)
    for number in layout.numbers:
        name = f"{names[number.body]}.{number.name}"
        put(name, number.start, BODY_NUMBERS[number.name])
    for name in layout.contact:
        put(f"contact.{name}", layout.contact_coordinate(name), 1)
    return found


def _body_site(number: BodyNumber, name: str, coordinates: Any) -> Site:
    """Site of what is inferred of a body besides its density."""
    count = BODY_NUMBERS[number.name]
    center = coordinates.scales.center[number.name]
    spread = coordinates.scales.spread[number.name]
    origin, unit = number_scale(
        number, coordinates.surroundings, coordinates.scene.gyration
    )
    loc, scale = origin + unit * center, unit * spread
    return Site(
        f"{name}.{number.name}",
        tuple(range(number.start, number.start + count)),
        "log" if number.name in LOGARITHMIC else "identity",
        loc if count > 1 else loc[0],
        scale if count > 1 else scale[0],
    )


def _slot_sites(slot: SlotKey, name: str, coordinates: Any) -> list[Site]:
    """Sites of all numbers of one slot."""
    sites = []
    for field, entry, first, count in _NUMBERS[slot.kind]:
        places = tuple(range(slot.start + first, slot.start + first + count))
        if field in ("heading", "axis"):
            loc, one = _direction(slot, coordinates), jnp.ones(())
            sites.append(Site(f"{name}.{field}", places, "half_turn", loc, one))
            continue
        center = coordinates.scales.center[entry]
        spread = coordinates.scales.spread[entry]
        origin, unit = _origin_and_unit(slot, field, coordinates)
        if entry in LOGARITHMIC:
            link, loc, scale = "log", center + jnp.log(unit), spread
        elif entry in _LOGISTIC:
            link, loc, scale = "logit", center, spread
        else:
            link = "arcsinh" if entry in _WITH_TAILS else "identity"
            loc, scale = origin + unit * center, unit * spread
        if count > 1:
            loc, scale = (jnp.broadcast_to(value, (count,)) for value in (loc, scale))
        sites.append(Site(f"{name}.{field}", places, link, loc, scale))
    return sites


def _direction(slot: SlotKey, coordinates: Any) -> Array:
    """Where a direction is measured from [rad]."""
    if slot.kind == "wheel":
        return jnp.zeros(())
    return coordinates.surroundings.rest[coordinates.layout.rests.index(slot), 3]


def _origin_and_unit(
    slot: SlotKey, field: str, coordinates: Any
) -> tuple[Array, Array]:
    """Where a number is measured from, and in multiples of what."""
    a, b, around = slot.body_a, slot.body_b, coordinates.surroundings
    reach = around.radius + around.spread
    zero, one = jnp.zeros(()), jnp.ones(())
    if slot.kind == "revolute" and field == "anchor_a":
        frame = around.meeting[coordinates.layout.meetings.index(slot)]
        return anchor_scale(slot, frame, reach)
    if field == "anchor_b":
        return (around.center[a], reach[a]) if b == WORLD else (zero, reach[b])
    if field == "anchor_a":
        return zero, reach[a]
    if field == "angle":
        return around.rest[coordinates.layout.rests.index(slot), 2], one
    if field == "position":
        return around.box_center[a], around.half_extents[a]
    if field in ("half_track", "load_shift", "offset"):
        return zero, around.radius[a]
    return zero, one


@jax.jit
def _dependence(coordinates: Any, z: Array, active: Array) -> list[Array]:
    """Derivative of every number of the hypothesis by every coordinate."""

    def numbers(z: Array) -> list[Array]:
        leaves = jax.tree.leaves(coordinates(z, active))
        return [x.ravel() for x in leaves if jnp.issubdtype(x.dtype, jnp.floating)]

    return jax.jacfwd(numbers)(z)


def _free_coordinates(coordinates: Any) -> np.ndarray:
    """Coordinates on which the hypothesis depends; the scene gives the others' part."""
    layout = coordinates.layout
    # Away from zero, where an anchor's arm would not change to first order.
    z = jnp.full(layout.dim, 0.5)
    derivatives = _dependence(coordinates, z, jnp.ones(len(layout.slots), bool))
    return np.any([np.any(np.asarray(d) != 0, axis=0) for d in derivatives], axis=0)
