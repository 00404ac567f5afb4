r"""From standard-normal coordinates to Φ: the prior as a map.

Every number of Φ is a smooth function of coordinates that are standard normal a priori
(a direction: uniform over half a turn), so that the prior density of Φ is the
push-forward of that simple one. Drawers and welds have as many coordinates as there are
different ones: a drawer a direction, a distance across it and an angle, a weld a pose,
from where the body was seen (`resting`); so is where a pin holds, and how long a rod is
(`meeting`). Coefficients are sampled relative to mass and weight: what a motion tells
of them does not depend on the mass, and where only gravity acts the mass drops out
exactly.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import on_device
from boomdp_jax.inference.hypotheses.body_numbers import numbers_of, with_numbers
from boomdp_jax.inference.hypotheses.contact_prediction import ContactScene
from boomdp_jax.inference.hypotheses.layout import Layout, SlotKey
from boomdp_jax.inference.hypotheses.meeting import meeting_frame, meeting_numbers
from boomdp_jax.inference.hypotheses.prior import PriorScales
from boomdp_jax.inference.hypotheses.resting import rest_numbers, rest_pose
from boomdp_jax.inference.hypotheses.slot_shapes import BODY_SHAPES, JOINT_SHAPES
from boomdp_jax.inference.hypotheses.stance import stance_numbers
from boomdp_jax.physics.params import (
    Distance,
    Ground,
    Params,
    Prismatic,
    Revolute,
    Surface,
    Weld,
    Wheel,
)
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.scene_spec import SceneSpec

# Weight per mass by which friction limits are scaled where the floor carries no load.
_STANDARD_GRAVITY = 9.81


class Surroundings(eqx.Module):
    """Sizes of a block's bodies and of their motion, by which the prior is scaled."""

    radius: Float[Array, " body"]
    """Farthest point of the outline from the centre of mass [m]."""
    half_extents: Float[Array, "body 2"]
    """Of the outline's bounding box in the body frame [m]."""
    box_center: Float[Array, "body 2"]
    """Of the same box [m]."""
    center: Float[Array, "body 2"]
    """Mean of the observed positions [m]."""
    spread: Float[Array, " body"]
    """How far from it the positions lie [m]."""
    centroid: Float[Array, "body 2"]
    """Where the centre of mass should be, in the frame of the body's pose [m]."""
    push: Float[Array, " body"]
    """Root mean square of the forces that were commanded, one where there were none
    [N]."""
    rest: Float[Array, "rest 4"]
    """Pose of `Layout.rests` and the way they moved most; see `rest_pose`."""
    meeting: Float[Array, "meeting 4"]
    """Where bodies of `Layout.meetings` were; see `meeting_frame`."""
    density: Float[Array, " body"]
    """Known density, NaN where it is to be inferred [kg/m²]."""
    known: dict[int, dict[str, Float[Array, "..."]]]
    """Numbers of known constraints by entry; NaN where they are to be inferred."""


def surroundings(
    spec: SceneSpec,
    bodies: tuple[int, ...],
    layout: Layout,
    poses: np.ndarray,
    forces: np.ndarray,
) -> Surroundings:
    """Measure what the prior needs to know of a block.

    Args:
        spec: the scene.
        bodies: indices of the block's bodies in the scene.
        layout: its slots.
        poses: observed poses `[reading, body, 3]` [m, m, rad]; NaN where missing.
        forces: commanded, `[row, body, 2]` [N].

    Returns:
        The sizes, on the default float type.
    """
    lows, highs, radii, centers, spreads = [], [], [], [], []
    positions = poses[..., :2]
    for i, index in enumerate(bodies):
        body = spec.bodies[index]
        corners = body.vertices if body.radius == 0 else None
        low = -body.radius * np.ones(2) if corners is None else corners.min(0)
        high = body.radius * np.ones(2) if corners is None else corners.max(0)
        radius = body.radius if corners is None else np.hypot(*corners.T).max()
        seen = positions[:, i][np.all(np.isfinite(positions[:, i]), axis=-1)]
        if len(seen) == 0:
            seen = np.zeros((1, 2)) if body.pose is None else body.pose[None, :2]
        center = seen.mean(0)
        lows.append(low)
        highs.append(high)
        radii.append(radius)
        centers.append(center)
        spreads.append(np.sqrt(((seen - center) ** 2).sum(-1).mean()))
    lows, highs = np.stack(lows), np.stack(highs)
    known = {
        slot.known: {
            key: on_device(number)
            for key, number in spec.constraints[slot.known].numbers.items()
        }
        for slot in layout.known_slots
    }
    square = np.sum(forces**2, axis=(0, 2)) / max(len(forces), 1)
    authored = (spec.bodies[i].pose for i in bodies)
    start = np.array([np.zeros(3) if pose is None else pose for pose in authored])
    rest = [rest_pose(slot, poses, start) for slot in layout.rests]
    meeting = [meeting_frame(slot, poses, start) for slot in layout.meetings]
    return Surroundings(
        radius=on_device(radii),
        half_extents=on_device((highs - lows) / 2),
        box_center=on_device((highs + lows) / 2),
        center=on_device(np.stack(centers)),
        spread=on_device(spreads),
        centroid=on_device(
            [
                body.moments.centroid if body.is_center_unknown else np.zeros(2)
                for body in (spec.bodies[i] for i in bodies)
            ]
        ),
        push=on_device(np.sqrt(np.where(square > 0, square, 1.0))),
        rest=on_device(np.reshape(rest, (-1, 4))),
        meeting=on_device(np.reshape(meeting, (-1, 4))),
        density=on_device(
            [
                np.nan if spec.bodies[i].density is None else spec.bodies[i].density
                for i in bodies
            ]
        ),
        known=known,
    )


class _Body(NamedTuple):
    """Numbers of one body that its constraints are scaled by."""

    mass: Float[Array, ""]
    gyration: Float[Array, ""]
    weight: Float[Array, ""]


def _place(slot: SlotKey) -> tuple[str, int, int]:
    """Where a slot's numbers go: joints count over the block, others per body."""
    body = slot.body_a if slot.kind in BODY_SHAPES else 0
    return slot.kind, body, slot.index


class Contact(eqx.Module):
    """What a block's bodies may touch: each other, and walls."""

    world: ContactScene
    friction: Float[Array, " surface"]
    """Of the block's bodies, then of the walls; NaN where it is to be inferred."""
    restitution: Float[Array, " surface"]


class Coordinates(eqx.Module):
    """The map from coordinates and active slots to `Params` of one block."""

    layout: Layout = eqx.field(static=True)
    scales: PriorScales
    surroundings: Surroundings
    scene: Scene
    contact: Contact | None = None
    """None: nothing collides."""

    @property
    def world(self) -> Scene | ContactScene:
        """What likelihoods step."""
        return self.scene if self.contact is None else self.contact.world

    def __call__(self, z: Float[Array, " dim"], active: Bool[Array, " slot"]) -> Params:
        """Params of a hypothesis; slots that are not active hold zeros.

        Args:
            z: coordinates.
            active: which inferred slots are active.

        Returns:
            Φ, with law-shape nuisances.
        """
        around = self.surroundings
        num_bodies = self.layout.num_bodies
        density = jnp.where(
            jnp.isfinite(around.density),
            around.density,
            jnp.exp(self._scaled("density", z[:num_bodies])),
        )
        density = jnp.where(self.scene.is_static, 1.0, density)
        gravity = self.scene.normal_gravity
        bodies = [
            _Body(
                mass=density[i] * self.scene.area[i],
                gyration=self.scene.gyration[i],
                weight=jnp.where(gravity > 0, gravity, _STANDARD_GRAVITY),
            )
            for i in range(num_bodies)
        ]
        made: dict[tuple, dict] = {}
        for i, slot in enumerate(self.layout.slots):
            made[_place(slot)] = self._numbers(slot, z, bodies, active[i])
        for slot in self.layout.known_slots:
            numbers = self._numbers(slot, z, bodies, jnp.asarray(True))
            for key, value in around.known[slot.known].items():
                numbers[key] = jnp.where(jnp.isnan(value), numbers[key], value)
            made[_place(slot)] = numbers
        has = {slot.kind for slot in self.layout.rests}
        params = Params(
            density=density,
            revolute=Revolute(**self._joint_arrays("revolute", made)),
            distance=Distance(**self._joint_arrays("distance", made)),
            wheel=Wheel(**self._body_arrays("wheel", made)),
            ground=Ground(**self._body_arrays("ground", made)),
            surface=None if self.contact is None else self._surface(self.contact, z),
            prismatic=Prismatic(**self._joint_arrays("prismatic", made))
            if "prismatic" in has
            else None,
            weld=Weld(**self._joint_arrays("weld", made)) if "weld" in has else None,
        )
        numbers = numbers_of(z, self.layout, self.scales, around, self.scene.gyration)
        return with_numbers(params, numbers) if numbers else params

    def contact_numbers(self, z: Float[Array, " dim"]) -> dict[str, Float[Array, ""]]:
        """Numbers of contact that are inferred, by `Layout.contact`."""
        links = {"friction": jnp.exp, "restitution": jax.nn.sigmoid}
        return {
            name: links[name](
                self._scaled(f"contact.{name}", z[self.layout.contact_coordinate(name)])
            )
            for name in self.layout.contact
        }

    def _surface(self, contact: Contact, z) -> Surface:
        """Contact of the block's bodies, and of the walls after them."""
        numbers, out = self.contact_numbers(z), {}
        for name in ("friction", "restitution"):
            known = getattr(contact, name)
            if name in numbers:
                known = jnp.where(jnp.isnan(known), numbers[name], known)
            out[name] = known
        return Surface(**out)

    def _scaled(self, name: str, z):
        return self.scales.scaled(name, z)

    def _numbers(self, slot: SlotKey, z, bodies: list[_Body], active) -> dict:
        """Numbers of one slot, zero where it is not active."""
        around, a = self.surroundings, slot.body_a
        z = z[slot.start :]
        body = bodies[a]
        known = around.known.get(slot.known, {})
        numbers: dict = {}
        if slot in self.layout.meetings:
            numbers |= meeting_numbers(
                slot,
                z,
                around.meeting[self.layout.meetings.index(slot)],
                around.radius + around.spread,
                around.center[a],
                around.radius[a],
                self.scales,
                known,
            )
        elif slot in self.layout.rests:
            rest = around.rest[self.layout.rests.index(slot)]
            numbers |= rest_numbers(
                slot.kind, z, rest, around.radius[a], self.scales, known
            )
        if slot.kind == "revolute":
            arm = body.gyration + jnp.sum(numbers["anchor_a"] ** 2)
            rate = jnp.exp(self._scaled("revolute.viscous_rate", z[4]))
            share = jnp.exp(self._scaled("revolute.dry_share", z[5]))
            numbers["viscous"] = body.mass * arm * rate
            numbers["dry"] = body.mass * body.weight * jnp.sqrt(arm) * share
        elif slot.kind == "prismatic":
            rate = jnp.exp(self._scaled("prismatic.viscous_rate", z[3]))
            share = jnp.exp(self._scaled("prismatic.dry_share", z[4]))
            numbers["viscous"] = body.mass * rate
            numbers["dry"] = body.mass * body.weight * share
        elif slot.kind == "wheel":
            numbers["position"] = around.box_center[a] + around.half_extents[
                a
            ] * self._scaled("wheel.position", z[0:2])
            numbers["heading"] = z[2]
            lateral = body.mass * jnp.exp(self._scaled("wheel.lateral_rate", z[3]))
            limit = body.mass * body.weight
            limit = limit * jnp.exp(self._scaled("wheel.lateral_limit", z[4]))
            rolling = jax.nn.sigmoid(self._scaled("wheel.viscous_ratio", z[5]))
            ratio = jax.nn.sigmoid(self._scaled("wheel.dry_ratio", z[6]))
            numbers["viscous"] = jnp.stack([lateral * rolling, lateral])
            numbers["dry"] = jnp.stack([limit * ratio, limit])
            numbers["half_track"] = around.radius[a] * jnp.exp(
                self._scaled("wheel.half_track", z[7])
            )
        elif slot.kind == "ground":
            numbers["dry"] = jnp.exp(self._scaled("ground.friction", z[0]))
            knee = jnp.exp(self._scaled("ground.knee_speed", z[1]))
            load = body.mass * self.scene.normal_gravity
            numbers["viscous"] = numbers["dry"] * load / knee
            numbers["torque_share"] = jax.nn.sigmoid(
                self._scaled("ground.torque_share", z[2])
            )
            numbers["load_shift"] = around.radius[a] * self._scaled(
                "ground.load_shift", z[3:5]
            )
            numbers |= stance_numbers(self.scales, self.scene, a, z[5:9])
        numbers = {key: jnp.where(active, value, 0.0) for key, value in numbers.items()}
        numbers["active"] = active
        return numbers

    def _joint_arrays(self, kind: str, made: dict) -> dict:
        """Fields of the joints of a kind, `[joint, ...]`."""
        layout = self.layout
        slots = sorted(
            (s for s in layout.slots + layout.known_slots if s.kind == kind),
            key=lambda slot: slot.index,
        )
        arrays = {
            key: jnp.stack([made[kind, 0, s.index][key] for s in slots])
            if slots
            else jnp.zeros((0, *shape), bool if key == "active" else float)
            for key, shape in JOINT_SHAPES[kind].items()
        }
        for key in ("body_a", "body_b"):
            values = [getattr(slot, key) for slot in slots]
            arrays[key] = jnp.asarray(values, jnp.int32).reshape(len(slots))
        return arrays

    def _body_arrays(self, kind: str, made: dict) -> dict:
        """Fields of the wheels or grounds of all bodies, `[body, slot, ...]`."""
        num, num_bodies = self.layout.count(kind), self.layout.num_bodies
        empty = {
            key: jnp.zeros(shape, bool if key == "active" else float)
            for key, shape in BODY_SHAPES[kind].items()
        }
        arrays = {}
        for key, none in empty.items():
            values = [
                made.get((kind, body, i), empty)[key]
                for body in range(num_bodies)
                for i in range(num)
            ]
            stacked = (
                jnp.stack(values) if values else jnp.zeros((0, *none.shape), none.dtype)
            )
            arrays[key] = stacked.reshape(num_bodies, num, *none.shape)
        return arrays
