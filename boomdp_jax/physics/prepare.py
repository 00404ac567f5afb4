"""What depends on scene, params and step length alone, out of the time loop."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.core.holding import hold, runtime_one
from boomdp_jax.core.written_out import one_loop_of_arrays
from boomdp_jax.physics.body_friction import with_sizes_of_feet
from boomdp_jax.physics.friction import (
    KNEE_SPEED,
    Contact,
    Spin,
    friction_points,
    joint_spin,
    wheel_headings,
)
from boomdp_jax.physics.implicit_fit import (
    Groups,
    contact_groups,
    fit_weights,
    implicit_weight,
)
from boomdp_jax.physics.islands import joint_islands
from boomdp_jax.physics.joints import Ends, Joints, joints_of, of_body
from boomdp_jax.physics.lone_body import LoneBody, Pin, lone_body
from boomdp_jax.physics.lone_rail import (
    Rail,
    can_be_on_rail,
    rail_of,
    rail_params,
)
from boomdp_jax.physics.params import Params, Prismatic, Revolute
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.small_linear import dot3, matvec3

MOST_LONE_CONTACTS = 16
"""Contacts of a lone body that are written out one by one: above, the general solver,
which stacks them, compiles faster."""

_FAR = 1e9
"""A limit that is never met [rad, m]."""


class Bodies(NamedTuple):
    """Masses and frictions of bodies, in frames of their own.

    Without the body axis in a scene of one body.
    """

    length: FloatScalar
    """Of a substep [s]."""
    mobile: Float[Array, "*body"]
    """One, or zero for a static body."""
    mass: Float[Array, "*body"]
    inertia: Float[Array, "*body"]
    weight: tuple[Float[Array, "*body"], Float[Array, "*body"]]
    """Impulse of gravity over a substep [N s]."""
    contacts: Contact | None
    spins: Spin | None


class Drive(NamedTuple):
    """What acts along the coordinates that slots of a kind leave free."""

    friction: Spin | None
    """Impulses in place of forces."""
    motor: Spin | None
    """Likewise."""
    target: Float[Array, "slot lane"] | None
    """Speed of the motor [rad/s, m/s]."""
    lower: Float[Array, "slot lane"] | None
    """Ends of the range [rad, m]."""
    upper: Float[Array, "slot lane"] | None


class Prepared(NamedTuple):
    """What depends on scene, params and step length alone, in lanes."""

    length: Float[Array, " lane"]
    mobile: Float[Array, "body lane"]
    mass: Float[Array, "body lane"]
    inertia: Float[Array, "body lane"]
    weight: tuple[Float[Array, "body lane"], Float[Array, "body lane"]]
    contacts: Contact | None
    spins: Spin | None
    joints: Joints
    turning: Drive | None
    """Of the revolute slots."""
    sliding: Drive | None
    """Of the prismatic slots."""
    islands: Float[Array, "body lane"] | None
    """A name of what joints tie together; None where there is a single body."""


def is_lone(scene: Scene, params: Params) -> bool:
    """Whether there is one body, with what `lone_body` knows to solve at once."""
    pins = params.revolute
    return (
        scene.num_bodies == 1
        and pins.active.shape[-1] <= 1
        and params.distance.active.shape[-1] == 0
        and pins.limit is None
        and pins.motor is None
        and can_be_on_rail(params)
        and contact_groups(scene, params).num_contacts <= MOST_LONE_CONTACTS
    )


def prepare_lone(
    scene: Scene, params: Params, length: FloatScalar
) -> tuple[LoneBody, Rail | None]:
    """Prepare a scene of which `is_lone` holds.

    Args:
        scene: outlines, feet, gravity.
        params: one hypothesis.
        length: of a step [s].

    Returns:
        All that its time loop needs, and what else holds the body.
    """
    rail = rail_of(params)
    if rail is not None:
        scene, params = rail_params(scene, params)
    numbers = one_loop_of_arrays(_lone_numbers, *_told(scene, params), length)
    mobile = 1.0 - scene.is_static[0].astype(scene.area.dtype)
    return LoneBody(length / scene.num_substeps, mobile, *numbers), rail


def _told(scene: Scene, params: Params) -> tuple[Scene, Params]:
    """What counts of both: no corners, no indices, and nothing of other kinds."""
    seen = eqx.tree_at(lambda s: (s.vertices, s.vertex_mask), scene, (None, None))

    def masks(params: Params) -> tuple:
        return params.revolute.active, params.wheel.active, params.ground.active

    def others(params: Params) -> tuple:
        joints, more = params.revolute, (params.prismatic, params.weld)
        return joints.body_a, joints.body_b, params.distance, params.surface, *more

    said = eqx.tree_at(others, params, (None,) * 6, is_leaf=lambda x: x is None)
    return seen, eqx.tree_at(masks, said, replace_fn=lambda on: jnp.asarray(on, bool))


def _lone_numbers(scene: Scene, params: Params, length: FloatScalar) -> tuple:
    """A lone body's numbers, but for the first two, the same for all hypotheses."""
    bodies, groups = prepare_bodies(scene, params, length, is_one_loop=True)
    facing = jnp.zeros_like(bodies.mass)
    if groups.num_wheels:
        facing = wheel_headings(params.wheel)[0, 0]
    body = lone_body(
        bodies.length,
        bodies.mobile,
        bodies.mass,
        bodies.inertia,
        bodies.weight,
        bodies.contacts,
        groups,
        facing,
        bodies.spins,
        _pins(params.revolute, bodies.mass.dtype),
    )
    return tuple(body)[2:]


def prepare_world(
    scene: Scene, params: Params, length: Float[Array, " lane"]
) -> Prepared:
    """Prepare any scene.

    Args:
        scene: outlines, feet, gravity; in lanes, like the others.
        params: hypotheses.
        length: of a step [s].

    Returns:
        All that the time loop needs.
    """

    def of_one(scene, params, length):
        return prepare_bodies(scene, params, length, is_one_loop=False)[0]

    bodies = jax.vmap(of_one, in_axes=-1, out_axes=-1)(scene, params, length)
    length = bodies.length
    if bodies.contacts is not None:
        num_feet = params.ground.active.shape[-2] * scene.feet.shape[-3]
        bodies = bodies._replace(contacts=with_sizes_of_feet(bodies.contacts, num_feet))
    if scene.area.shape[0] == 1:
        bodies = jax.tree.map(lambda leaf: leaf[..., None, :], bodies)
        bodies = bodies._replace(length=length)
    joints = joints_of(params, bodies.mass.dtype)
    turning = sliding = None
    if joints.turns is not None:
        ease = _both(joints.turns, bodies.mobile / bodies.inertia)
        has_friction = scene.area.shape[0] > 1
        turning = _drive(params.revolute, ease, length, has_friction)
    if joints.guides is not None and params.prismatic is not None:
        ease = _both(joints.guides, bodies.mobile / bodies.mass)
        sliding = _drive(params.prismatic, ease, length, True)
    islands = joint_islands(joints, bodies.mobile)
    return Prepared(*bodies, joints, turning, sliding, islands)


def prepare_bodies(
    scene: Scene, params: Params, length: FloatScalar, *, is_one_loop: bool
) -> tuple[Bodies, Groups]:
    """Masses, frictions with impulses in place of forces, and their blend weights.

    Args:
        scene: outlines, feet, gravity; not in lanes.
        params: one hypothesis.
        length: of a step [s].
        is_one_loop: whether all of it becomes one loop, where nothing is worked out
            twice.

    Returns:
        What is of each body, and which points of friction belong together. Of a lone
        body the friction of its pins is among that against spin.
    """
    length = length / scene.num_substeps
    dtype = scene.area.dtype
    mobile = 1.0 - scene.is_static.astype(dtype)
    # A static body gets a mass of one and no impulse, which keeps it where it is.
    mass = jnp.where(scene.is_static, 1.0, params.density * scene.area)
    inertia = jnp.where(scene.is_static, 1.0, mass * scene.gyration)
    contacts, spins = friction_points(scene, params, mass)
    pins = []
    if scene.num_bodies == 1:
        mobile, mass, inertia = (array[0] for array in (mobile, mass, inertia))
        contacts, spins = jax.tree.map(lambda array: array[:, 0], (contacts, spins))
        pins = _pins(params.revolute, dtype)
    if pins:
        revolute = params.revolute
        joints = joint_spin(revolute.viscous, revolute.dry, revolute.active)
        spins = (
            joints
            if spins is None
            else jax.tree.map(lambda *parts: jnp.concatenate(parts), spins, joints)
        )
    inverse = _mobility(pins, mass, inertia)
    one = runtime_one(mass)

    def held(values):
        # Else the compiler works all of this out again for whatever reads it.
        if is_one_loop:
            return values
        return jax.tree.map(
            lambda leaf: hold(leaf, jnp.broadcast_to(one, leaf.shape)), values
        )

    groups = contact_groups(scene, params)
    contacts, spins, inverse = held((contacts, spins, inverse))
    contacts, spins = held(
        fit_weights(groups, contacts, spins, inverse, mass, inertia, mobile, length)
    )
    weight = (length * mass * scene.gravity[0], length * mass * scene.gravity[1])
    return Bodies(length, mobile, mass, inertia, weight, contacts, spins), groups


def _pins(revolute: Revolute, dtype) -> list[Pin]:
    """Slots of a scene of one body."""
    return [
        Pin(
            active=revolute.active[slot].astype(dtype),
            anchor_a=(revolute.anchor_a[slot, 0], revolute.anchor_a[slot, 1]),
            anchor_b=(revolute.anchor_b[slot, 0], revolute.anchor_b[slot, 1]),
        )
        for slot in range(revolute.active.shape[0])
    ]


def _both(ends: Ends, ease: Float[Array, "body lane"]) -> Float[Array, "slot lane"]:
    """Speed per impulse between two bodies, each otherwise free."""
    at_b = jnp.where(ends.has_b > 0.0, of_body(ends.b, ease), 0.0)
    return ends.on * (of_body(ends.a, ease) + at_b)


def _drive(
    joint: Revolute | Prismatic, ease, length: Float[Array, " lane"], has_friction: bool
) -> Drive:
    """Friction, motor and limits of a kind, impulses in place of forces."""
    friction = motor = target = lower = upper = None
    # In single precision a stiffness beyond this would drown inertias in rounding.
    most = 1e-4 / jnp.finfo(ease.dtype).eps / jnp.where(ease > 0.0, ease, 1.0)

    def bounded(spin: Spin) -> Spin:
        viscous = length[None] * spin.viscous
        scale = jnp.minimum(1.0, most / jnp.where(viscous > 0.0, viscous, 1.0))
        scale = jnp.where(viscous > 0.0, scale, 1.0)
        viscous = viscous * scale
        return Spin(viscous, spin.knee * scale, implicit_weight(viscous * ease))

    if has_friction:
        friction = bounded(joint_spin(joint.viscous, joint.dry, joint.active))
    if joint.motor is not None:
        target, strength = joint.motor[:, 0], joint.motor[:, 1]
        motor = bounded(joint_spin(strength / KNEE_SPEED, strength, joint.active))
        motor = motor._replace(weight=jnp.ones_like(target))
    if joint.limit is not None:
        on = joint.active
        # Finite, for the sake of derivatives.
        lower = jnp.where(on, jnp.maximum(joint.limit[:, 0], -_FAR), -_FAR)
        upper = jnp.where(on, jnp.minimum(joint.limit[:, 1], _FAR), _FAR)
    return Drive(friction, motor, target, lower, upper)


def _mobility(pins: list[Pin], mass, inertia):
    """Twist per impulse in the body frame, with pins to the world held."""
    zero = jnp.zeros_like(mass)
    inverse = [
        [1.0 / mass, zero, zero],
        [zero, 1.0 / mass, zero],
        [zero, zero, 1.0 / inertia],
    ]
    if mass.ndim > 0:
        return inverse
    for slot in pins:
        (x, y), on = slot.anchor_a, slot.active
        for row in ((on, zero, -on * y), (zero, on, on * x)):
            push = matvec3(inverse, row)
            ease = dot3(row, push)
            is_free = ease > 1e-6 * (on / mass) + (1 - on)
            scale = jnp.where(is_free, 1.0 / jnp.where(is_free, ease, 1.0), 0.0)
            inverse = [
                [inverse[i][j] - push[i] * push[j] * scale for j in range(3)]
                for i in range(3)
            ]
    return inverse
