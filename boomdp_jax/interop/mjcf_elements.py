r"""What of MuJoCo stands for which law of a planar scene, written and read back.

Friction of a wheel, a foot or a joint is a force against a velocity with a limit,
$f = -\mathrm{clip}(c u, -d, d)$: an actuator without control. MuJoCo has them one
direction at a time, so that a wheel's ellipse of limits becomes a box, and the disc of
a foot becomes four directions, 45° apart, of

$$c_k = \tfrac12 c, \qquad d_k = \tfrac{\pi}{8} d,$$

which are isotropic while the foot sticks. When it slips they all have reached their
limits, and their sum has one of eight directions: as large as $d$ within 6 % along the
motion, and up to 22.5° off it, so that the path of what slides bends towards the
nearest of them. MuJoCo has no coefficient of restitution: a spring and damper give it
back.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from boomdp_jax.physics.body_spec import BodySpec
from boomdp_jax.physics.friction import KNEE_SPEED

HALF_THICKNESS = 0.1
"""Half the extent of outlines across the plane [m]."""

FAR = 1e5
"""Stands for the missing end of a range [rad, m]."""

BOUNCE_STEPS = 12
"""Most steps that a bouncing contact lasts. A restitution of 0.6 comes out between 0.57
and 0.63 with these, by where the impact falls in a step."""

SOFT_STEPS = 8
"""Steps in which a contact without restitution comes to rest. Of a box put down sliding
two make it hop by 6 mm at any time step; eight leave 0.6 mm."""

FOOT_ANGLES = (0.0, math.pi / 4, math.pi / 2, 3 * math.pi / 4)
"""Directions along which a foot rubs [rad]."""

FOOT_LIMIT = math.pi / 8
"""Limit along each of them over that of the foot: right on average over directions."""

FOOT_VISCOUS = 0.5
"""Viscous coefficient along each of them over that of the foot."""


def numbers(values: Iterable[float | int | np.floating]) -> str:
    """Numbers as an attribute, to the last digit.

    Args:
        values: the numbers.

    Returns:
        Text from which they are read back to the bit.
    """
    return " ".join(repr(float(value)) for value in values)


def velocity_force(
    viscous: float, limit: float, *, speed: float = 0.0, **place: str
) -> dict[str, str]:
    """Attributes of an actuator that drives towards a speed, whatever its control.

    Args:
        viscous: force per difference of speed [N s/m, N m s/rad].
        limit: largest force [N, N m]; infinite for none.
        speed: where the force vanishes [m/s, rad/s].
        **place: the joint, or the site and gear, on which it acts, and its name.

    Returns:
        Attributes of an element `general`.
    """
    attributes = {
        **place,
        "gainprm": "0",
        "biastype": "affine",
        "biasprm": numbers((viscous * speed, 0.0, -viscous)),
    }
    if math.isfinite(limit):
        attributes |= {"forcelimited": "true", "forcerange": numbers((-limit, limit))}
    return attributes


def along(angle: float) -> str:
    """Gear of a force on a site along a direction of its frame.

    Args:
        angle: the direction, from the site's first axis [rad].

    Returns:
        Six numbers.
    """
    return numbers((math.cos(angle), math.sin(angle), 0, 0, 0, 0))


def is_coulomb(viscous: float, dry: float) -> bool:
    """Whether friction is dry friction alone, as a scene file gives it by its limit.

    Args:
        viscous: coefficient of the law [N m s/rad, N s/m].
        dry: its limit [N m, N].

    Returns:
        True if the coefficient is the one that follows from the limit.
    """
    return math.isclose(viscous, dry / KNEE_SPEED, rel_tol=1e-5)


def bounce_spring(restitution: float, time_step: float) -> tuple[float, float]:
    """MuJoCo's `solref` of a contact that gives back a share of the speed.

    Args:
        restitution: the share, above 0; 1 gives an undamped spring.
        time_step: MuJoCo's time step [s].

    Returns:
        Stiffness and damping, both negative as MuJoCo has it [1/s², 1/s].
    """
    least, most = 0.0, 1e8
    for _ in range(200):
        ratio = 0.5 * (least + most)
        is_less = _restitution(ratio) > restitution
        least, most = (ratio, most) if is_less else (least, ratio)
    rate = math.pi / (BOUNCE_STEPS * time_step * max(1.0, ratio))
    return -(rate**2), -2.0 * ratio * rate


def restitution_of(solref: Float[np.ndarray, "2"]) -> float:
    """The restitution that `bounce_spring` was given; zero of a usual contact.

    Args:
        solref: a contact's.

    Returns:
        Speed after an impact over that before.
    """
    stiffness, damping = float(solref[0]), float(solref[1])
    if stiffness >= 0.0:
        return 0.0
    return _restitution(-damping / (2.0 * math.sqrt(-stiffness)))


def _restitution(ratio: float) -> float:
    r"""What a spring and damper that do not pull give back of a speed.

    With a damping ratio of $\sin\alpha$ it is $e^{-(\pi - 2\alpha)\tan\alpha}$, with
    $\zeta > 1$ it is $(\zeta + s)^{-2\zeta/s}$, $s = \sqrt{\zeta^2 - 1}$. Schwager and
    Pöschel (2007), "Coefficient of restitution and linear-dashpot model revisited".
    """
    if abs(ratio - 1.0) < 1e-9:
        return math.exp(-2.0)
    if ratio < 1.0:
        angle = math.asin(ratio)
        return math.exp(-(math.pi - 2.0 * angle) * math.tan(angle))
    root = math.sqrt(ratio**2 - 1.0)
    return math.exp(-2.0 * ratio / root * math.log(ratio + root))


def surface(friction: float, restitution: float, time_step: float) -> dict[str, str]:
    """Attributes of a geom that touches others, or of a pair of them.

    Args:
        friction: coefficient of dry friction.
        restitution: speed after an impact over that before.
        time_step: MuJoCo's time step [s].

    Returns:
        Attributes that `geom` and `pair` share, but for friction, of which they take
        another number of coefficients.
    """
    attributes = {"condim": "3" if friction > 0.0 else "1"}
    spring = (SOFT_STEPS * time_step, 1.0)
    if restitution > 0.0:
        spring = bounce_spring(restitution, time_step)
    return attributes | {"solref": numbers(spring), "solimp": "0.99 0.99 0.001"}


def shape(assets: ET.Element, body: BodySpec) -> dict[str, str]:
    """Attributes of a geom that has a body's outline; without mass.

    Args:
        assets: where the mesh of a polygon is put.
        body: the body; the geom is in the frame of its pose.

    Returns:
        Type, size and place.
    """
    if body.kind == "circle":
        return {"type": "sphere", "mass": "0", "size": repr(body.radius)}
    if body.kind == "box":
        least, most = body.vertices.min(axis=0), body.vertices.max(axis=0)
        return {
            "type": "box",
            "mass": "0",
            "size": numbers((*(0.5 * (most - least)), HALF_THICKNESS)),
            "pos": numbers((*(0.5 * (most + least)), 0.0)),
        }
    corners = [
        (x, y, z) for z in (-HALF_THICKNESS, HALF_THICKNESS) for x, y in body.vertices
    ]
    vertices = numbers(value for corner in corners for value in corner)
    ET.SubElement(assets, "mesh", name=f"{body.name}.outline", vertex=vertices)
    return {"type": "mesh", "mass": "0", "mesh": f"{body.name}.outline"}


def turned(vector: Float[np.ndarray, "2"], angle: float) -> Float[np.ndarray, "2"]:
    """A vector turned counter-clockwise.

    Args:
        vector: in the plane.
        angle: by how much [rad].

    Returns:
        The turned vector.
    """
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin], [sin, cos]]) @ vector
