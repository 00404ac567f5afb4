"""What depends on scene, params and step length alone, out of the time loop."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.core.holding import hold, runtime_one
from boomdp_jax.physics.friction import (
    Contact,
    Spin,
    friction_points,
    joint_spin,
    wheel_headings,
)
from boomdp_jax.physics.implicit_fit import (
    contact_groups,
    fit_weights,
    implicit_weight,
)
from boomdp_jax.physics.joints import Slot, joint_slots, select
from boomdp_jax.physics.lone_body import LoneBody, lone_body
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.small_linear import dot3, matvec3

MOST_LONE_CONTACTS = 16
"""Contacts of a lone body that are written out one by one: above, the general solver,
which stacks them, compiles faster."""


class Prepared(NamedTuple):
    """What depends on scene, params and step length alone, out of the time loop."""

    length: FloatScalar
    mobile: Float[Array, " body"]
    mass: Float[Array, " body"]
    inertia: Float[Array, " body"]
    weight: tuple[Float[Array, " body"], Float[Array, " body"]]
    contacts: Contact | None
    spins: Spin | None
    slots: list[Slot]
    """Pins, then rods."""
    joint_spins: list[tuple[Slot, Spin]]


def prepare(scene: Scene, params: Params, length: FloatScalar) -> Prepared | LoneBody:
    """Masses, frictions with impulses in place of forces, and their blend weights."""
    length = length / scene.num_substeps
    dtype = scene.area.dtype
    mobile = 1.0 - scene.is_static.astype(dtype)
    # A static body gets a mass of one and no impulse, which keeps it where it is.
    mass = jnp.where(scene.is_static, 1.0, params.density * scene.area)
    inertia = jnp.where(scene.is_static, 1.0, mass * scene.gyration)
    contacts, spins = friction_points(scene, params, mass)
    if scene.num_bodies == 1:
        mobile, mass, inertia = (array[0] for array in (mobile, mass, inertia))
        contacts, spins = jax.tree.map(lambda array: array[:, 0], (contacts, spins))
    revolute = params.revolute
    pins = joint_slots(revolute, scene.num_bodies)
    rods = joint_slots(params.distance, scene.num_bodies)
    joints = joint_spin(revolute.viscous, revolute.dry, revolute.active)
    joint_spins = []
    if scene.num_bodies > 1:
        joint_spins = [
            _fit_joint(
                slot,
                jax.tree.map(lambda leaf, i=i: leaf[i], joints),
                mobile / inertia,
                length,
            )
            for i, slot in enumerate(pins)
        ]
    elif pins:
        spins = (
            joints
            if spins is None
            else jax.tree.map(lambda *parts: jnp.concatenate(parts), spins, joints)
        )
    inverse = _mobility(pins, mass, inertia)
    one = runtime_one(mass)

    def held(values):
        # Else the compiler works all of this out again for whatever reads it.
        return jax.tree.map(
            lambda leaf: hold(leaf, jnp.broadcast_to(one, leaf.shape)), values
        )

    groups = contact_groups(scene, params)
    contacts, spins, inverse = held((contacts, spins, inverse))
    contacts, spins = held(
        fit_weights(groups, contacts, spins, inverse, mass, inertia, mobile, length)
    )
    weight = (length * mass * scene.gravity[0], length * mass * scene.gravity[1])
    is_lone = scene.num_bodies == 1 and len(pins) <= 1 and not rods
    if is_lone and groups.num_contacts <= MOST_LONE_CONTACTS:
        facing = jnp.zeros_like(mass)
        if groups.num_wheels:
            facing = wheel_headings(params.wheel)[0, 0]
        return lone_body(
            length,
            mobile,
            mass,
            inertia,
            weight,
            contacts,
            groups,
            facing,
            spins,
            pins,
        )
    prepared = Prepared(
        length=length,
        mobile=mobile,
        mass=mass,
        inertia=inertia,
        weight=weight,
        contacts=contacts,
        spins=spins,
        slots=pins + rods,
        joint_spins=joint_spins,
    )
    return jax.tree.map(
        lambda leaf: (
            # Likewise, for every state and every step.
            leaf
            if leaf is length or not jnp.issubdtype(leaf.dtype, jnp.floating)
            else hold(leaf, jnp.reshape(one, (-1,))[0])
        ),
        prepared,
    )


def _fit_joint(slot: Slot, spin: Spin, ease, length) -> tuple[Slot, Spin]:
    """Friction between two bodies with impulses in place of torques."""
    viscous = length * spin.viscous
    decay = viscous * slot.active * (select(slot.a, ease) + select(slot.b, ease))
    return slot, Spin(viscous, spin.knee, implicit_weight(decay))


def _mobility(pins: list[Slot], mass, inertia):
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
