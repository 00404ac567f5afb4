"""Random worlds that no author of the engine chose: `random_scenes.py` steps them."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from boomdp_jax.physics import Params, Scene, State
from boomdp_jax.physics.params import (
    WORLD,
    Distance,
    Ground,
    Prismatic,
    Revolute,
    Surface,
    Weld,
    Wheel,
    empty_params,
)

NUM_BODIES, NUM_CORNERS, NUM_REVOLUTE = 6, 5, 3
FASTEST = 50.0
"""Greatest speed at the start [m/s]."""
HEAVIEST = 1000.0
"""Greatest mass, the least being one [kg]."""


class World(NamedTuple):
    """One of them."""

    scene: Scene
    params: Params
    state: State


class Kinds(NamedTuple):
    """What worlds may have."""

    contact: bool
    joints: bool


class _Draws:
    """Random numbers, each from a key of its own."""

    def __init__(self, key):
        self._keys = iter(jax.random.split(key, 64))

    def uniform(self, low, high, *shape):
        return jax.random.uniform(next(self._keys), shape, minval=low, maxval=high)

    def decades(self, low, high, *shape):
        return jnp.exp(self.uniform(jnp.log(low), jnp.log(high), *shape))

    def chance(self, share, *shape):
        return jax.random.bernoulli(next(self._keys), share, shape)

    def integer(self, low, high, *shape):
        return jax.random.randint(next(self._keys), shape, low, high)

    def normal(self, *shape):
        return jax.random.normal(next(self._keys), shape)


def draw_world(key, kinds: Kinds) -> World:
    """Bodies, joints that hold at the start, floors and wheels; a step of 20 ms.

    Args:
        key: of the random numbers.
        kinds: what it may have.

    Returns:
        One to six bodies of 2 cm to half a metre within two or twelve metres, up to
        `FASTEST` and `HEAVIEST`, which may overlap; the others stand still and touch
        nothing.
    """
    draws = _Draws(key)
    present = jnp.arange(NUM_BODIES) < draws.integer(1, NUM_BODIES + 1)
    corners, radius, area, gyration = _outlines(draws)
    is_static = draws.chance(0.15, NUM_BODIES) | ~present
    mass = draws.decades(1.0, HEAVIEST, NUM_BODIES)
    reach = jnp.where(draws.chance(0.5), 1.0, 6.0)
    place = draws.uniform(-1.0, 1.0, NUM_BODIES, 2) * reach
    pose = jnp.column_stack([place, draws.uniform(-3.0, 3.0, NUM_BODIES)])
    twist = _twists(draws, is_static)
    is_upright = draws.chance(0.5)
    together = present[:, None] & present[None] & ~jnp.eye(NUM_BODIES, dtype=bool)
    scene = Scene(
        vertices=corners,
        vertex_mask=jnp.ones((NUM_BODIES, NUM_CORNERS), bool),
        radius=radius,
        area=area,
        gyration=gyration,
        feet=jnp.stack(
            [corners[:, 0], corners[:, 1], corners[:, 2], -corners[:, 0]], 1
        ),
        foot_load=jnp.full((NUM_BODIES, 4), 0.25),
        is_static=is_static,
        gravity=jnp.where(is_upright, jnp.array([0.0, -9.81]), 0.0),
        normal_gravity=jnp.where(is_upright, 0.0, 9.81),
        dt=jnp.asarray(0.02),
        collides=together if kinds.contact else None,
        num_substeps=4,
    )
    surface = Surface(
        friction=draws.uniform(0.0, 1.5, NUM_BODIES),
        restitution=draws.uniform(0.0, 1.0, NUM_BODIES),
    )
    held = {}
    if kinds.joints:
        held = _joints(draws, pose, present, is_static) | _floors(draws)
    else:
        empty = empty_params(NUM_BODIES)
        names = ("revolute", "distance", "wheel", "ground")
        held = {name: getattr(empty, name) for name in names}
    params = Params(density=mass / area, surface=surface, **held)
    return World(scene, params, State(pose, twist))


def _outlines(draws: _Draws) -> tuple:
    """Circles, boxes and uneven pentagons about their centres of mass."""
    kind = draws.integer(0, 3, NUM_BODIES)
    size = draws.decades(0.02, 0.5, NUM_BODIES)
    angle = 2 * jnp.pi * jnp.arange(NUM_CORNERS) / NUM_CORNERS
    angle = angle + draws.uniform(-0.4, 0.4, NUM_BODIES, NUM_CORNERS)
    axes = draws.uniform(0.5, 1.0, NUM_BODIES, 2)
    pentagon = jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1) * axes[:, None]
    signs = jnp.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, 1]])
    box = signs * draws.uniform(0.3, 1.0, NUM_BODIES, 2)[:, None]
    corners = jnp.where((kind == 1)[:, None, None], box, pentagon)
    corners = corners * size[:, None, None]
    cross, after = _crosses(corners)
    centre = jnp.sum(cross[..., None] * (corners + after), axis=1)
    centre = centre / (3.0 * jnp.sum(cross, axis=1))[:, None]
    corners = corners - centre[:, None]
    cross, after = _crosses(corners)
    area = 0.5 * jnp.sum(cross, axis=1)
    squares = jnp.sum(corners**2 + corners * after + after**2, axis=-1)
    gyration = jnp.sum(cross * squares, axis=1) / (12.0 * area)
    is_circle = kind == 0
    return (
        jnp.where(is_circle[:, None, None], 0.0, corners),
        jnp.where(is_circle, size, 0.0),
        jnp.where(is_circle, jnp.pi * size**2, area),
        jnp.where(is_circle, 0.5 * size**2, gyration),
    )


def _crosses(corners) -> tuple:
    after = jnp.roll(corners, -1, axis=1)
    x, y = corners[..., 0], corners[..., 1]
    return x * after[..., 1] - y * after[..., 0], after


def _twists(draws: _Draws, is_static):
    fastest = draws.decades(0.1, FASTEST)
    twist = draws.normal(NUM_BODIES, 3) * fastest * jnp.array([0.6, 0.6, 1.0])
    speed = jnp.linalg.norm(twist[:, :2], axis=-1, keepdims=True)
    twist = twist * jnp.minimum(1.0, FASTEST / jnp.maximum(speed, 1e-6))
    return jnp.where(is_static[:, None], 0.0, twist)


def _turned(angle, points):
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    x, y = points[:, 0], points[:, 1]
    return jnp.column_stack([cos * x - sin * y, sin * x + cos * y])


def _ties(draws: _Draws, pose, present, is_static, share: float, num: int) -> dict:
    """Slots whose anchors are the same point at the start."""
    a = draws.integer(0, NUM_BODIES, num)
    b = draws.integer(WORLD, NUM_BODIES, num)
    point = pose[a, :2] + draws.uniform(-0.5, 0.5, num, 2)
    to_world = b == WORLD
    on_b = jnp.where(
        to_world[:, None], point, _turned(-pose[b, 2], point - pose[b, :2])
    )
    stays = is_static[a] & (to_world | is_static[b])
    exists = (a != b) & present[a] & (to_world | present[b]) & ~stays
    return {
        "active": exists & draws.chance(share, num),
        "body_a": a,
        "body_b": b,
        "anchor_a": _turned(-pose[a, 2], point - pose[a, :2]),
        "anchor_b": on_b,
    }


def _angle(pose, ends: dict):
    b = ends["body_b"]
    return pose[ends["body_a"], 2] - jnp.where(b == WORLD, 0.0, pose[b, 2])


def _friction(draws: _Draws, *shape) -> dict:
    viscous = draws.decades(0.02, 7.0, *shape) * draws.chance(0.5, *shape)
    return {
        "viscous": viscous,
        "dry": jnp.where(draws.chance(0.5, *shape), jnp.inf, 1.0),
    }


def _joints(draws: _Draws, pose, present, is_static) -> dict:
    def ties(share, num):
        return _ties(draws, pose, present, is_static, share, num)

    pins, rods, welds = ties(0.4, NUM_REVOLUTE), ties(0.2, 1), ties(0.1, 1)
    guides = ties(0.15, 1)
    # A rod reaches from another point of its first body.
    shift = draws.uniform(-0.2, 0.2, 1, 2) + 0.05
    rods["anchor_a"] = rods["anchor_a"] + shift
    return {
        "revolute": Revolute(**pins, **_friction(draws, NUM_REVOLUTE)),
        "distance": Distance(**rods, length=jnp.linalg.norm(shift, axis=-1)),
        "weld": Weld(**welds, angle=_angle(pose, welds)),
        "prismatic": Prismatic(
            **guides,
            axis=draws.uniform(-3.0, 3.0, 1),
            angle=_angle(pose, guides),
            **_friction(draws, 1),
            limit=jnp.array([[-0.5, 0.5]]),
        ),
    }


def _floors(draws: _Draws) -> dict:
    slots = (NUM_BODIES, 1)
    return {
        "wheel": Wheel(
            active=draws.chance(0.2, *slots),
            position=draws.uniform(-0.2, 0.2, *slots, 2),
            heading=draws.uniform(-3.0, 3.0, *slots),
            viscous=draws.decades(0.1, 3000.0, *slots, 2),
            dry=jnp.where(
                draws.chance(0.5, *slots, 2),
                jnp.inf,
                draws.decades(0.1, 20.0, *slots, 2),
            ),
        ),
        "ground": Ground(
            active=draws.chance(0.3, *slots),
            dry=draws.uniform(0.0, 1.0, *slots),
            viscous=draws.decades(1.0, 400.0, *slots),
        ),
    }
