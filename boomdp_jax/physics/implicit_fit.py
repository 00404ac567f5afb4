"""How implicit each friction is: impulses in place of forces, and their blend weights.

Contacts of one kind share their weights and the bound on their stiffness: the wheels of
an axle one for rolling and one for lateral motion, the feet of a ground one altogether.
What is isotropic stays so, and a lone body needs the blended motion only once for all
(`lone_contacts`).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.physics.friction import Contact, Spin
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.small_linear import dot3, matvec3


class Groups(NamedTuple):
    """How the contacts of `friction.friction_points` belong together."""

    num_wheels: int
    """Wheel slots."""
    num_sides: int
    """Contacts of each; contact i of slot s is number i * num_wheels + s."""
    num_grounds: int
    """Ground slots, after all wheels."""
    num_feet: int
    """Contacts of each; contact i of slot s is number s * num_feet + i among them."""

    @property
    def num_contacts(self) -> int:
        """All of them."""
        return self.num_wheels * self.num_sides + self.num_grounds * self.num_feet

    def shared(
        self, pair: tuple[Array, Array], reduce: Callable
    ) -> tuple[Array, Array]:
        """One value for the contacts of each group.

        Args:
            pair: rolling and lateral values `[contact, *body]`.
            reduce: over a leading axis of some group, such as `jnp.sum`.

        Returns:
            What each contact's group has: both directions together for feet.
        """
        num = self.num_wheels * self.num_sides
        body = pair[0].shape[1:]
        sides = [
            reduce(v[:num].reshape(self.num_sides, self.num_wheels, *body))
            for v in pair
        ]
        sides = [jnp.tile(v, (self.num_sides, *(1 for _ in body))) for v in sides]
        feet = jnp.concatenate(
            [v[num:].reshape(self.num_grounds, self.num_feet, *body) for v in pair], 1
        )
        feet = jnp.repeat(reduce(jnp.swapaxes(feet, 0, 1)), self.num_feet, axis=0)
        return jnp.concatenate([sides[0], feet]), jnp.concatenate([sides[1], feet])


def contact_groups(scene: Scene, params: Params) -> Groups:
    """Which contacts belong together."""
    return Groups(
        num_wheels=params.wheel.active.shape[-1],
        num_sides=1 if params.wheel.half_track is None else 2,
        num_grounds=params.ground.active.shape[-1],
        num_feet=scene.feet.shape[-2],
    )


def implicit_weight(decay: Float[Array, "..."]) -> Float[Array, "..."]:
    r"""Share of the end velocity that makes a step exact for linear decay.

    With $z$ the decay over a step (rate times length), a step that applies friction at
    $\vartheta u' + (1-\vartheta) u$ multiplies a velocity by
    $(1-(1-\vartheta)z)/(1+\vartheta z)$. For $\vartheta = 1/(1-e^{-z}) - 1/z$ this
    is $e^{-z}$, and the response to a constant force is exact too. It tends to 1/2
    (second order) where friction is slow and to 1 (backward Euler, no overshoot) where
    it is stiff. Exponential fitting: Liniger and Willoughby (1970), SIAM J. Numer.
    Anal. 7, 47.
    """
    is_small = decay < 0.05
    z = jnp.where(is_small, 1.0, decay)
    exact = -1.0 / jnp.expm1(-z) - 1.0 / z
    return jnp.where(is_small, 0.5 + decay / 12.0, exact)


def fit_weights(
    groups: Groups,
    contacts: Contact | None,
    spins: Spin | None,
    inverse,
    mass,
    inertia,
    mobile,
    length,
) -> tuple[Contact | None, Spin | None]:
    """Turn forces into impulses, bound their stiffness, and fit the blend weights.

    In single precision a stiffness beyond `bound` times the inertia would drown the
    inertia in rounding, so it is held there: what is left of the velocity after a step
    is then one part in `bound`.

    Args:
        groups: which contacts share weights and bound.
        contacts: from `friction_points`.
        spins: likewise.
        inverse: twist per impulse in the body frame, 3 x 3 entries per body.
        mass: of each body [kg].
        inertia: of each body [kg m²].
        mobile: one for bodies that move, zero for static ones.
        length: of the step [s].

    Returns:
        Both, coefficients times the length of the step.
    """
    bound = 1e-4 / jnp.finfo(mass.dtype).eps
    zero = jnp.zeros_like(mass)
    damping = [[zero] * 3 for _ in range(3)]

    def least(viscous, ease):
        """What scales a coefficient down to the bound."""
        whole = jnp.where(viscous > 0, length * viscous, 1.0)
        return jnp.where(viscous > 0, jnp.minimum(1.0, bound / (ease * whole)), 1.0)

    def plain_ease(row):
        return (row[0] ** 2 + row[1] ** 2) / mass[None] + row[2] ** 2 / inertia[None]

    if contacts is not None:
        rows = (contacts.rolling, contacts.lateral)
        scale = groups.shared(
            tuple(
                least(c, plain_ease(row))
                for c, row in zip(contacts.viscous, rows, strict=True)
            ),
            lambda values: jnp.min(values, axis=0),
        )
        scale = tuple(mobile[None] * s for s in scale)
        contacts = contacts._replace(
            viscous=tuple(
                length * c * s for c, s in zip(contacts.viscous, scale, strict=True)
            ),
            knee=tuple(g * s for g, s in zip(contacts.knee, scale, strict=True)),
        )
        for row, v in zip(rows, contacts.viscous, strict=True):
            damping = [
                [damping[i][j] + jnp.sum(v * row[i] * row[j], axis=0) for j in range(3)]
                for i in range(3)
            ]
        if contacts.size is not None:
            # Less stiff than the feet's own directions: no bound is needed.
            own = jnp.sum(contacts.viscous[1] * contacts.size**2, axis=0)
            damping[2][2] = damping[2][2] + own
    if spins is not None:
        scale = mobile[None] * least(spins.viscous, 1.0 / inertia[None])
        spins = spins._replace(
            viscous=length * spins.viscous * scale, knee=spins.knee * scale
        )
        damping[2][2] = damping[2][2] + jnp.sum(spins.viscous, axis=0)
    inverse = [[entry[None] for entry in row] for row in inverse]
    damping = [[entry[None] for entry in row] for row in damping]

    def eases(row):
        """Velocity per impulse along a row, and its decay by all friction."""
        push = matvec3(inverse, row)
        ease = dot3(row, push)
        is_free = ease > 1e-6 * plain_ease(row)
        loss = dot3(push, matvec3(damping, push))
        return jnp.where(is_free, ease, 0.0), jnp.where(is_free, loss, 0.0)

    def weight(ease, loss):
        is_free = ease > 0
        return implicit_weight(
            jnp.where(is_free, loss / jnp.where(is_free, ease, 1.0), 0.0)
        )

    if contacts is not None:
        # The mean over a group, by what each contact contributes.
        parts = [
            tuple(c * part for part in eases(row))
            for c, row in zip(contacts.viscous, rows, strict=True)
        ]
        if contacts.size is not None:
            none = jnp.zeros_like(contacts.size)
            own = eases((none, none, contacts.size))
            parts[1] = tuple(
                part + contacts.viscous[1] * extra
                for part, extra in zip(parts[1], own, strict=True)
            )
        ease, loss = (
            groups.shared(pair, lambda values: jnp.sum(values, axis=0))
            for pair in zip(*parts, strict=True)
        )
        contacts = contacts._replace(
            weight=tuple(weight(e, p) for e, p in zip(ease, loss, strict=True))
        )
    if spins is not None:
        none = jnp.zeros_like(spins.viscous)
        spins = spins._replace(weight=weight(*eases((none, none, none + 1.0))))
    return contacts, spins
