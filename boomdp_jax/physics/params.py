"""Φ: every latent physical number of one hypothesis, in fixed slots with masks."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.core.arrays import on_device

WORLD = -1
"""Index that stands for the world as a joint's partner."""


class Revolute(eqx.Module):
    """Pins: an anchor of body `a` and one of body `b` (or a world point) coincide."""

    active: Bool[Array, "*batch joint"]
    body_a: Int[Array, "*batch joint"]
    body_b: Int[Array, "*batch joint"]
    """Partner; `WORLD` for the world."""
    anchor_a: Float[Array, "*batch joint 2"]
    """In the frame of body `a` [m]."""
    anchor_b: Float[Array, "*batch joint 2"]
    """In the frame of body `b`, or of the world [m]."""
    viscous: Float[Array, "*batch joint"]
    """Joint friction torque per relative spin [N m s/rad]."""
    dry: Float[Array, "*batch joint"]
    """Largest joint friction torque [N m]; infinite for purely viscous friction."""
    limit: Float[Array, "*batch joint 2"] | None = None
    """Least and largest theta_a - theta_b (the world's is zero, angles are not wrapped)
    [rad]; infinite where there is none. None: of no joint."""
    motor: Float[Array, "*batch joint 2"] | None = None
    """Relative spin that a motor drives at [rad/s] and its largest torque [N m]; a
    torque of zero is no motor. None: of no joint."""


class Distance(eqx.Module):
    """Rods: an anchor of `a` stays `length` away from one of `b` or of the world."""

    active: Bool[Array, "*batch joint"]
    body_a: Int[Array, "*batch joint"]
    body_b: Int[Array, "*batch joint"]
    anchor_a: Float[Array, "*batch joint 2"]
    anchor_b: Float[Array, "*batch joint 2"]
    length: Float[Array, "*batch joint"]
    """Rest length [m]."""


class Weld(eqx.Module):
    """Two bodies, or one and the world, as one: anchors coincide and turn together."""

    active: Bool[Array, "*batch joint"]
    body_a: Int[Array, "*batch joint"]
    body_b: Int[Array, "*batch joint"]
    anchor_a: Float[Array, "*batch joint 2"]
    anchor_b: Float[Array, "*batch joint 2"]
    angle: Float[Array, "*batch joint"]
    """theta_a - theta_b [rad]."""


class Prismatic(eqx.Module):
    """Drawers: an anchor of `a` slides along a line fixed in `b`, without turning."""

    active: Bool[Array, "*batch joint"]
    body_a: Int[Array, "*batch joint"]
    body_b: Int[Array, "*batch joint"]
    anchor_a: Float[Array, "*batch joint 2"]
    anchor_b: Float[Array, "*batch joint 2"]
    """A point of the line, from which the slide counts."""
    axis: Float[Array, "*batch joint"]
    """Direction of the line, in the frame of `b` or of the world [rad]."""
    angle: Float[Array, "*batch joint"]
    """theta_a - theta_b [rad]."""
    viscous: Float[Array, "*batch joint"]
    """Friction force per speed of the slide [N s/m]."""
    dry: Float[Array, "*batch joint"]
    """Largest friction force [N]; infinite for purely viscous friction."""
    limit: Float[Array, "*batch joint 2"] | None = None
    """Least and largest slide [m]; infinite where there is none. None: of no joint."""
    motor: Float[Array, "*batch joint 2"] | None = None
    """Speed that a motor drives at [m/s] and its largest force [N]; a force of zero is
    no motor. None: of no joint."""


class Wheel(eqx.Module):
    """Anisotropic friction at a pose in the body frame, one row of slots per body."""

    active: Bool[Array, "*batch body wheel"]
    position: Float[Array, "*batch body wheel 2"]
    """Where the wheel touches the floor, body frame [m]."""
    heading: Float[Array, "*batch body wheel"]
    """Direction of rolling in the body frame [rad]."""
    viscous: Float[Array, "*batch body wheel 2"]
    """Force per speed, rolling and lateral [N s/m]."""
    dry: Float[Array, "*batch body wheel 2"]
    """Largest force, rolling and lateral [N]; infinite for a purely viscous wheel."""
    half_track: Float[Array, "*batch body wheel"] | None = None
    """Half the distance of two equal wheels on the axle [m]; None: one contact."""


class Ground(eqx.Module):
    """Isotropic friction between a body's feet and the floor."""

    active: Bool[Array, "*batch body ground"]
    dry: Float[Array, "*batch body ground"]
    """Friction coefficient; infinite for purely viscous friction."""
    viscous: Float[Array, "*batch body ground"]
    """Force per speed, all feet together [N s/m]."""
    torque_share: Float[Array, "*batch body ground"] | None = None
    """Share of the friction torque that does not depend on sliding, in [0, 1]."""
    load_shift: Float[Array, "*batch body ground 2"] | None = None
    """Offset of the centre of load from the feet's own, body frame [m]."""
    stance_scale: Float[Array, "*batch body ground 2"] | None = None
    """How far apart the feet are, over the scene's, along and across the longer axis
    of the outline (`Scene.stance_axis`), and how large; None: one."""
    corner_share: Float[Array, "*batch body ground"] | None = None
    """Share of the load that has gone from all feet to the outermost, in [0, 1]
    (`Scene.corner_load`), the others having shrunk as well; None: zero."""
    diagonal_share: Float[Array, "*batch body ground"] | None = None
    """Share of the load of four legs on one diagonal, in [0, 1], by
    `Scene.diagonal`, as legs that are not equally long have it; None: a half."""


class Surface(eqx.Module):
    """What a body's outline does to others that touch it.

    Two bodies rub with the geometric mean of their coefficients, and bounce with the
    larger of their restitutions.
    """

    friction: Float[Array, "*batch body"]
    """Coefficient of dry friction."""
    restitution: Float[Array, "*batch body"]
    """Speed after an impact over that before, in [0, 1]."""


class Actuator(eqx.Module):
    """What acts on bodies, given what was commanded; see `actuator`."""

    gain: Float[Array, "*batch body"] | None = None
    """Wrench applied over wrench commanded; None: one."""
    bias: Float[Array, "*batch body 3"] | None = None
    """Wrench applied besides, world frame [N, N, N m]; None: zero."""
    delay: Float[Array, "*batch body"] | None = None
    """How much later a command takes effect [s]; None: at once."""


class Params(eqx.Module):
    """One hypothesis Φ. Structure is which slots are active; shapes never change."""

    density: Float[Array, "*batch body"]
    """Mass per area [kg/m²]."""
    revolute: Revolute
    distance: Distance
    wheel: Wheel
    ground: Ground
    surface: Surface | None = None
    """What contact is like; needed in scenes with contact (`Scene.collides`)."""
    prismatic: Prismatic | None = None
    weld: Weld | None = None
    center_of_mass: Float[Array, "*batch body 2"] | None = None
    """Where it lies in the body frame, whose origin is the reference point of states
    and wrenches [m]; None: there."""
    actuator: Actuator | None = None
    """None: what is commanded acts."""


def empty_params(
    num_bodies: int,
    *,
    num_revolute: int = 0,
    num_distance: int = 0,
    num_wheel: int = 0,
    num_ground: int = 0,
    num_prismatic: int = 0,
    num_weld: int = 0,
    density: float = 1.0,
    friction: float | None = None,
    restitution: float = 0.0,
) -> Params:
    """Params with every slot inactive and holding zeros.

    Args:
        num_bodies: bodies in the scene.
        num_revolute: revolute slots of the whole scene.
        num_distance: distance slots of the whole scene.
        num_wheel: wheel slots of each body.
        num_ground: ground slots of each body.
        num_prismatic: prismatic slots of the whole scene; without one there is no
            such group at all, and a lone body keeps its quick step.
        num_weld: weld slots of the whole scene, likewise.
        density: density of every body [kg/m²].
        friction: contact friction of every body; None: the params have no surface,
            which scenes with contact need.
        restitution: contact restitution of every body, if there is a surface.

    Returns:
        The params, unbatched, without law-shape nuisances.
    """

    def joint_slots(num: int) -> dict:
        return {
            "active": on_device(np.zeros(num), bool),
            "body_a": on_device(np.zeros(num), np.dtype(np.int32)),
            "body_b": on_device(np.full(num, WORLD), np.dtype(np.int32)),
            "anchor_a": on_device(np.zeros((num, 2))),
            "anchor_b": on_device(np.zeros((num, 2))),
        }

    return Params(
        density=on_device(np.full(num_bodies, density)),
        revolute=Revolute(
            **joint_slots(num_revolute),
            viscous=on_device(np.zeros(num_revolute)),
            dry=on_device(np.zeros(num_revolute)),
        ),
        distance=Distance(
            **joint_slots(num_distance), length=on_device(np.zeros(num_distance))
        ),
        wheel=Wheel(
            active=on_device(np.zeros((num_bodies, num_wheel)), bool),
            position=on_device(np.zeros((num_bodies, num_wheel, 2))),
            heading=on_device(np.zeros((num_bodies, num_wheel))),
            viscous=on_device(np.zeros((num_bodies, num_wheel, 2))),
            dry=on_device(np.zeros((num_bodies, num_wheel, 2))),
        ),
        ground=Ground(
            active=on_device(np.zeros((num_bodies, num_ground)), bool),
            dry=on_device(np.zeros((num_bodies, num_ground))),
            viscous=on_device(np.zeros((num_bodies, num_ground))),
        ),
        surface=None
        if friction is None
        else Surface(
            friction=on_device(np.full(num_bodies, friction)),
            restitution=on_device(np.full(num_bodies, restitution)),
        ),
        prismatic=Prismatic(
            **joint_slots(num_prismatic),
            **{
                key: on_device(np.zeros(num_prismatic))
                for key in ("axis", "angle", "viscous", "dry")
            },
        )
        if num_prismatic
        else None,
        weld=Weld(**joint_slots(num_weld), angle=on_device(np.zeros(num_weld)))
        if num_weld
        else None,
    )
