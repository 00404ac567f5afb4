"""Default prior scales, all in units of the object, and how a scene overrides them."""

import math
from typing import NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import on_device


class Scale(NamedTuple):
    """Median (or, for a plain number, mean) and sd on the scale that is sampled."""

    center: float
    spread: float


# Scales that worked over eight structures of one body: broad, but with under one per
# cent of a coefficient's prior below what a camera resolves, since a constraint too
# weak to see can never be excluded.
DEFAULT_SCALES: dict[str, Scale] = {
    # Log-normal, [kg/m²].
    "density": Scale(30.0, 1.5),
    # Joint friction, viscous as a rate against the inertia about the pin [1/s] and dry
    # as a share of the weight at the radius of gyration about the pin: log-normal.
    "revolute.viscous_rate": Scale(0.1, 2.0),
    "revolute.dry_share": Scale(0.01, 2.0),
    # Anchors, in units of body radius plus spread of the positions: normal.
    "revolute.anchor": Scale(0.0, 1.0),
    "distance.anchor": Scale(0.0, 1.0),
    # How far a pin is from where the readings have its anchor, in units of body radius,
    # with the tails of a hyperbolic sine. Narrow, because the likelihood takes where a
    # run starts as given: see `meeting`. A rod's length over that between its anchors
    # at the first reading: log-normal.
    "revolute.offset": Scale(0.0, 0.01),
    "distance.length": Scale(1.0, 0.1),
    # Of a drawer: its friction along the line, viscous over mass [1/s] and dry as a
    # share of the weight, log-normal; how far the line passes from the mean of the
    # observed positions, in units of body radius, and how far the angle is from the
    # mean of the observed ones [rad], both as a pin's offset.
    "prismatic.viscous_rate": Scale(0.1, 2.0),
    "prismatic.dry_share": Scale(0.03, 2.0),
    "prismatic.offset": Scale(0.0, 0.01),
    "prismatic.angle": Scale(0.0, 0.01),
    # Where a weld holds a body, likewise.
    "weld.offset": Scale(0.0, 0.01),
    "weld.angle": Scale(0.0, 0.01),
    # Wheel position in units of the outline's half extents: normal.
    "wheel.position": Scale(0.0, 0.7),
    # Lateral viscous coefficient over mass [1/s] and lateral limit over weight.
    "wheel.lateral_rate": Scale(60.0, 1.2),
    "wheel.lateral_limit": Scale(0.5, 0.7),
    # Rolling over lateral, viscous and dry: logit-normal, given as logits.
    "wheel.viscous_ratio": Scale(-2.5, 1.25),
    "wheel.dry_ratio": Scale(-2.5, 1.25),
    # Half the track, in units of the body's radius: log-normal.
    "wheel.half_track": Scale(0.2, 0.7),
    # Friction coefficient, and the speed at which it is reached [m/s]: log-normal.
    "ground.friction": Scale(0.3, 0.8),
    "ground.knee_speed": Scale(0.02, 1.2),
    # Share of decoupled torque: logit-normal. Load shift in radii: normal.
    "ground.torque_share": Scale(-1.0, 1.5),
    "ground.load_shift": Scale(0.0, 0.1),
    # How far apart feet are that the scene does not give, over an even pressure's, and
    # the share of the load that is on the outermost (`Ground`): log- and logit-normal.
    # Share of four legs' load on one diagonal: logit-normal.
    "ground.stance_scale": Scale(1.0, 0.3),
    "ground.corner_share": Scale(-1.0, 2.0),
    "ground.diagonal_share": Scale(0.0, 0.7),
    # How far it is from the centroid (or where the scene file says it should be), in
    # units of the outline's radius of gyration: normal.
    "center_of_mass": Scale(0.0, 0.3),
    # Wrench applied over wrench commanded: log-normal. A wrench besides, in units of
    # the root mean square of commanded forces (that times the radius of gyration for a
    # torque): normal. Delay [s]: log-normal.
    "actuator.gain": Scale(1.0, 0.3),
    "actuator.bias": Scale(0.0, 0.2),
    "actuator.delay": Scale(0.02, 1.0),
    # Of surfaces that touch, friction log-normal and restitution logit-normal: about
    # uniform.
    "contact.friction": Scale(0.3, 0.8),
    "contact.restitution": Scale(0.0, 1.5),
}
"""Centre and spread of every quantity that is inferred."""

LOGARITHMIC = frozenset(
    {
        "actuator.gain",
        "actuator.delay",
        "density",
        "revolute.viscous_rate",
        "revolute.dry_share",
        "distance.length",
        "prismatic.viscous_rate",
        "prismatic.dry_share",
        "wheel.lateral_rate",
        "wheel.lateral_limit",
        "wheel.half_track",
        "ground.friction",
        "ground.knee_speed",
        "ground.stance_scale",
        "contact.friction",
    }
)
"""Quantities that are sampled as logarithms; their centre is a median."""

DEFAULT_PROBABILITY: dict[str, float] = {
    "revolute": 0.2,
    "distance": 0.1,
    "prismatic": 0.1,
    "weld": 0.1,
    "wheel": 0.3,
    "ground": 0.5,
    # Between two bodies rather than to the world.
    "tie": 0.05,
}
"""Probability of each optional constraint, per body, or per pair for a tie."""

NOISE_GROUPS = ("position", "angle", "velocity", "spin")
"""Channels that share one noise scale."""

DEFAULT_NOISE: dict[str, float] = {
    "position": 1e-3,
    "angle": 1e-3,
    "velocity": 4e-3,
    "spin": 4e-3,
}
"""Scale of the inverse-gamma prior (shape 1) of each noise variance [m, rad, ../s]."""


class PriorScales(eqx.Module):
    """Numbers of the prior, as arrays, so that changing one recompiles nothing."""

    center: dict[str, Float[Array, ""]]
    """On the sampled scale: logarithm of the median for positive quantities."""
    spread: dict[str, Float[Array, ""]]
    noise: Float[Array, " 4"]
    """Scale of each noise group."""

    def scaled(
        self, name: str, z: Float[Array, "*coordinate"]
    ) -> Float[Array, "*coordinate"]:
        """A number, on the scale that is sampled, from standard-normal coordinates."""
        return self.center[name] + self.spread[name] * z

    def standard(
        self, name: str, value: Float[Array, "*coordinate"]
    ) -> Float[Array, "*coordinate"]:
        """The coordinates of a number: `scaled` backwards."""
        return (value - self.center[name]) / self.spread[name]


class PriorOptions(NamedTuple):
    """A scene's prior: scales, structure probabilities."""

    scales: dict[str, Scale]
    probability: dict[str, float]
    noise: dict[str, float]


def read_prior(overrides: dict, source: str) -> PriorOptions:
    """Default prior with a scene's overrides.

    Args:
        overrides: names of `DEFAULT_SCALES` with `{"center":, "spread":}` (either may
            be left out), `"probability": {kind: p}`, `"noise": {group: scale}`.
        source: name of the scene, for messages.

    Returns:
        The options.

    Raises:
        ValueError: an unknown name, a spread or scale that is not positive, a
            probability outside [0, 1].
    """
    scales, probability = dict(DEFAULT_SCALES), dict(DEFAULT_PROBABILITY)
    noise = dict(DEFAULT_NOISE)
    for name, value in overrides.items():
        where = f"{source}: prior: {name}"
        if name == "probability":
            for kind, p in _items(value, where):
                _check_name(kind, probability, where)
                if not _is_number(p) or not 0 <= p <= 1:
                    raise ValueError(f"{where}: {kind}: expected 0 to 1, got {p!r}")
                probability[kind] = float(p)
        elif name == "noise":
            for group, scale in _items(value, where):
                _check_name(group, noise, where)
                if not _is_number(scale) or scale <= 0:
                    raise ValueError(
                        f"{where}: {group}: expected a positive scale, got {scale!r}"
                    )
                noise[group] = float(scale)
        else:
            _check_name(name, scales, f"{source}: prior")
            given = dict(_items(value, where))
            for key in given:
                _check_name(key, {"center": 0, "spread": 0}, where)
            scale = Scale(
                *(
                    given.get(k, d)
                    for k, d in zip(Scale._fields, scales[name], strict=True)
                )
            )
            if not all(map(_is_number, scale)) or scale.spread <= 0:
                raise ValueError(
                    f"{where}: expected a finite center and a positive spread, got "
                    f"{given!r}"
                )
            if name in LOGARITHMIC and scale.center <= 0:
                raise ValueError(
                    f"{where}: expected a positive median, got {scale.center!r}"
                )
            scales[name] = Scale(float(scale.center), float(scale.spread))
    return PriorOptions(scales, probability, noise)


def prior_scales(options: PriorOptions) -> PriorScales:
    """The numbers of a prior as arrays."""
    return PriorScales(
        center={
            name: on_device(
                math.log(scale.center) if name in LOGARITHMIC else scale.center
            )
            for name, scale in options.scales.items()
        },
        spread={
            name: on_device(scale.spread) for name, scale in options.scales.items()
        },
        noise=on_device([options.noise[group] for group in NOISE_GROUPS]),
    )


def _items(value: object, where: str):
    if not isinstance(value, dict):
        raise ValueError(f"{where}: expected an object, got {value!r}")
    return value.items()


def _check_name(name: str, known: dict, where: str) -> None:
    if name not in known:
        raise ValueError(f"{where}: expected one of {', '.join(known)}; got {name!r}")


def _is_number(value: object) -> bool:
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and math.isfinite(value)
    )
