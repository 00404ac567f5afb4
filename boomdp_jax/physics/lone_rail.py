r"""A lone body in a drawer, or welded to the world: one motion left, or none.

In a drawer every point of a body moves alike, along the line. What rubs then might as
well do so at the centre of mass, and the drawer's own friction is that of a wheel there
that rolls along the line and does not hold across it. So a drawer is a body whose feet
are at its centre of mass, with one more wheel, pushed along the line alone
(`rail_params`): what `lone_step` solves without knowing of drawers. A wheel of a body
on a line is one more of that kind: with $u = (\cos\varphi, \sin\varphi)\,v$ for a line
at $\varphi$ from its heading, the friction law of `friction` has along it

$$f = -c\,v \min(1, |v|^{-1} / k), \quad c = c_r \cos^2\varphi + c_l \sin^2\varphi,
\quad k^2 = (c_r \cos\varphi / d_r)^2 + (c_l \sin\varphi / d_l)^2,$$

that of a wheel along the line with coefficient c and limit c / k. Before and after, the
motion is put on the line; an angle that is off is set right, and a place by the
shortest way.

A weld, or a drawer whose body is pinned as well, leaves one pose and no twist.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.physics.lone_contacts import Pair
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.params import Params, Prismatic, Wheel
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.trigonometry import sincos


class Rail(NamedTuple):
    """What holds a lone body besides a pin."""

    on_line: FloatScalar
    """One for a body that may only slide, else zero."""
    direction: Pair
    """Of the line, in the world."""
    is_fixed: FloatScalar
    """One for a body that may not move, else zero."""
    place: Pair
    """A centre of mass on the line, or the only one [m]."""
    angle: FloatScalar
    """The body's [rad]."""


def can_be_on_rail(params: Params) -> bool:
    """Whether this file knows the drawers and welds of a lone body."""
    guide, weld = params.prismatic, params.weld
    return (
        (guide is None or guide.active.shape[-1] <= 1)
        and (guide is None or (guide.limit is None and guide.motor is None))
        and (weld is None or weld.active.shape[-1] <= 1)
    )


def rail_of(params: Params) -> Rail | None:
    """The rail of a lone body; None where no slot can hold one."""
    guide, weld, pin = params.prismatic, params.weld, params.revolute
    slots = [
        slot for slot in (guide, weld) if slot is not None and slot.active.shape[0]
    ]
    if not slots:
        return None
    dtype = params.density.dtype
    zero = jnp.zeros((), dtype)
    on_line = is_fixed = angle = zero
    place, direction = (zero, zero), (zero + 1.0, zero)

    def hold(slot, anchor_slot):
        sin, cos = sincos(slot.angle[0])
        (ax, ay), (bx, by) = anchor_slot.anchor_a[0], anchor_slot.anchor_b[0]
        return slot.angle[0], (bx - cos * ax + sin * ay, by - sin * ax - cos * ay)

    def choose(is_on, new, old):
        return jnp.where(is_on, new, old)

    if guide is not None and guide.active.shape[0]:
        is_on = guide.active[0]
        sin, cos = sincos(guide.axis[0])
        direction = (choose(is_on, cos, 1.0), choose(is_on, sin, 0.0))
        angle, place = hold(guide, guide)
        on_line = is_on.astype(dtype)
        if pin.active.shape[0]:
            is_pinned = is_on & pin.active[0]
            at_pin = hold(guide, pin)[1]
            place = tuple(
                choose(is_pinned, p, q) for p, q in zip(at_pin, place, strict=True)
            )
            is_fixed = is_pinned.astype(dtype)
    if weld is not None and weld.active.shape[0]:
        is_on = weld.active[0]
        turn, point = hold(weld, weld)
        angle = choose(is_on, turn, angle)
        place = (choose(is_on, point[0], place[0]), choose(is_on, point[1], place[1]))
        is_fixed = choose(is_on, 1.0, is_fixed).astype(dtype)
    return Rail(on_line * (1.0 - is_fixed), direction, is_fixed, place, angle)


def rail_params(scene: Scene, params: Params) -> tuple[Scene, Params]:
    """Scene and hypothesis as `lone_step` is to see them.

    Args:
        scene: of one body.
        params: of which `can_be_on_rail` holds.

    Returns:
        The scene with points for feet, at the centre of mass, where a drawer is active,
        and params with wheels there along its line, one more for its own friction, its
        pin inactive, and no drawers or welds.
    """
    guide, ground, pin = params.prismatic, params.ground, params.revolute
    if guide is None or guide.active.shape[0] == 0:
        return scene, _replaced(params, prismatic=None, weld=None)
    is_on = guide.active[0]

    def unless(value: Array) -> Array:
        return jnp.where(is_on, 0.0, value)

    if ground.load_shift is not None:
        ground = _replaced(ground, load_shift=unless(ground.load_shift))
    params = _replaced(
        params,
        revolute=_replaced(pin, active=pin.active & ~is_on),
        ground=ground,
        wheel=_wheels_on_line(params.wheel, guide),
        prismatic=None,
        weld=None,
    )
    size = None if scene.foot_size is None else unless(scene.foot_size)
    return _replaced(scene, feet=unless(scene.feet), foot_size=size), params


def before_step(
    rail: Rail | None, motion: Motion, force: tuple
) -> tuple[Motion, tuple]:
    """Put a motion on the rail, and leave the part of a force that pushes along it."""
    if rail is None:
        return motion, force
    (tx, ty), on = rail.direction, rail.on_line
    along = force[0] * tx + force[1] * ty
    pushed = (along * tx, along * ty, jnp.zeros_like(along))
    force = tuple(jnp.where(on > 0, p, f) for p, f in zip(pushed, force, strict=True))
    return after_step(rail, motion), force


def after_step(rail: Rail | None, motion: Motion) -> Motion:
    """Put a motion on the rail."""
    if rail is None:
        return motion
    (tx, ty), (px, py) = rail.direction, rail.place
    slide = (motion.x - px) * tx + (motion.y - py) * ty
    speed = motion.vx * tx + motion.vy * ty
    zero = jnp.zeros_like(speed)
    sliding = Motion(
        px + slide * tx, py + slide * ty, rail.angle, speed * tx, speed * ty, zero
    )
    fixed = Motion(px, py, rail.angle, zero, zero, zero)
    return Motion(
        *(
            jnp.where(rail.is_fixed > 0, f, jnp.where(rail.on_line > 0, s, v))
            for f, s, v in zip(fixed, sliding, motion, strict=True)
        )
    )


def _wheels_on_line(wheel: Wheel, guide: Prismatic) -> Wheel:
    """Wheels as a drawer leaves them where it is active, and its own friction as one.

    All roll along the line at the centre of mass, and do not hold across it.
    """
    is_on, heading = guide.active, guide.axis - guide.angle
    sin, cos = sincos(heading[:, None] - wheel.heading)
    way = jnp.stack([cos, sin], axis=-1)
    along = jnp.sum(wheel.viscous * way**2, axis=-1)
    is_limited = (wheel.dry > 0) & jnp.isfinite(wheel.dry)
    share = wheel.viscous * way / jnp.where(is_limited, wheel.dry, 1.0)
    square = jnp.sum(jnp.where(is_limited, share, 0.0) ** 2, axis=-1)
    has_limit = square > 0
    knee = jnp.sqrt(jnp.where(has_limit, square, 1.0))
    limit = jnp.where(has_limit, along / knee, jnp.inf)
    own = Wheel(
        active=guide.active[None],
        position=jnp.zeros((1, *guide.anchor_a.shape), guide.anchor_a.dtype),
        heading=heading[None],
        viscous=_rolling(guide.viscous)[None],
        dry=_rolling(guide.dry)[None],
    )
    half_track = wheel.half_track
    if half_track is not None:
        half_track = jnp.where(is_on, 0.0, half_track)
        own = _replaced(own, half_track=jnp.zeros_like(own.heading))
    held = Wheel(
        active=wheel.active,
        position=jnp.where(is_on, 0.0, wheel.position),
        heading=jnp.where(is_on, heading, wheel.heading),
        viscous=jnp.where(is_on, _rolling(along), wheel.viscous),
        dry=jnp.where(is_on, _rolling(limit), wheel.dry),
        half_track=half_track,
    )
    return jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=1), held, own)


def _rolling(value: Array) -> Array:
    """A coefficient of rolling, and none across."""
    return jnp.stack([value, jnp.zeros_like(value)], axis=-1)


def _replaced(module, **changes):
    """The same with some fields changed."""
    return type(module)(**{**vars(module), **changes})
