"""Turns a reference world into the engine's own types, and runs it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.physics import Params, Scene, State, rollout
from boomdp_jax.physics.params import Distance, Ground, Revolute, Wheel
from tests.reference import planar_dynamics as reference

CHUNK = 50
"""Steps in one compiled call; longer runs repeat it, so a world compiles once."""


class Trajectory(NamedTuple):
    """What the engine did, after each step."""

    pose: np.ndarray
    twist: np.ndarray
    constraint_error: np.ndarray
    is_finite: np.ndarray


def make_scene(
    world: reference.World, *, dt: float = 0.02, num_substeps: int = 2
) -> Scene:
    """Give the engine a world's outlines, feet and gravity."""
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    vertices = np.array([corners * extents for extents in world.half_extents], float)
    return Scene(
        vertices=jnp.asarray(vertices, float),
        vertex_mask=jnp.ones(vertices.shape[:2], bool),
        radius=jnp.zeros(world.num_bodies),
        area=jnp.asarray(world.area, float),
        gyration=jnp.asarray(world.gyration, float),
        feet=jnp.asarray(world.feet, float),
        foot_load=jnp.full((world.num_bodies, 4), 0.25),
        is_static=jnp.zeros(world.num_bodies, bool),
        gravity=jnp.asarray(world.gravity, float),
        normal_gravity=jnp.asarray(world.normal_gravity, float),
        dt=jnp.asarray(dt, float),
        num_substeps=num_substeps,
    )


def make_params(
    world: reference.World, slots: tuple[int, int, int, int] | None = None
) -> Params:
    """Write a world's constraints into the first slots of each kind.

    Without `slots` (pins, rods, wheels, grounds) there are as many as needed.
    """
    wheel_counts = np.bincount(
        np.array([w.body for w in world.wheels], int), minlength=1
    )
    ground_counts = np.bincount(
        np.array([g.body for g in world.grounds], int), minlength=1
    )
    needed = (len(world.pins), len(world.rods), wheel_counts.max(), ground_counts.max())
    num_pins, num_rods, num_wheels, num_grounds = slots or needed

    def fill(rows, num, width=None, default=0.0):
        array = np.full((num, width) if width else num, default)
        if len(rows):
            array[: len(rows)] = np.asarray(rows)
        kinds = {"b": bool, "i": jnp.int32, "f": float}
        return jnp.asarray(array, kinds[array.dtype.kind])

    def joints(specs, num):
        return {
            "active": fill([True] * len(specs), num, default=False),
            "body_a": fill([s.a for s in specs], num, default=0),
            "body_b": fill([s.b for s in specs], num, default=-1),
            "anchor_a": fill([s.anchor_a for s in specs], num, 2),
            "anchor_b": fill([s.anchor_b for s in specs], num, 2),
        }

    def per_body(specs, value, num, width=None, default=0.0):
        rows = [
            fill([value(s) for s in specs if s.body == body], num, width, default)
            for body in range(world.num_bodies)
        ]
        return jnp.stack(rows)

    pins, rods, wheels, grounds = world.pins, world.rods, world.wheels, world.grounds
    return Params(
        density=jnp.asarray(world.density, float),
        revolute=Revolute(
            **joints(pins, num_pins),
            viscous=fill([p.viscous for p in pins], num_pins),
            dry=fill([p.dry for p in pins], num_pins),
        ),
        distance=Distance(
            **joints(rods, num_rods), length=fill([r.length for r in rods], num_rods)
        ),
        wheel=Wheel(
            active=per_body(wheels, lambda w: True, num_wheels, default=False),
            position=per_body(wheels, lambda w: w.position, num_wheels, 2),
            heading=per_body(wheels, lambda w: w.heading, num_wheels),
            viscous=per_body(wheels, lambda w: w.viscous, num_wheels, 2),
            dry=per_body(wheels, lambda w: w.dry, num_wheels, 2),
        ),
        ground=Ground(
            active=per_body(grounds, lambda g: True, num_grounds, default=False),
            dry=per_body(grounds, lambda g: g.dry, num_grounds),
            viscous=per_body(grounds, lambda g: g.viscous, num_grounds),
        ),
    )


def make_state(pose, twist=None) -> State:
    """State from nested lists, `[body, 3]` each; at rest by default."""
    pose = np.asarray(pose, float)
    twist = np.zeros_like(pose) if twist is None else np.asarray(twist, float)
    return State(pose=jnp.asarray(pose, float), twist=jnp.asarray(twist, float))


@jax.jit
def run_chunk(scene, params, state, wrenches, dt):
    """One compiled rollout."""
    return rollout(scene, params, state, wrenches, dt=dt)


def run(
    world: reference.World,
    pose,
    twist=None,
    *,
    num_steps: int,
    dt: float = 0.02,
    wrench=None,
    num_substeps: int = 2,
) -> Trajectory:
    """Roll a world out with the engine.

    A wrench is constant, `[body, 3]`, or given for every step, `[time, body, 3]`.
    """
    assert num_steps % CHUNK == 0
    scene = make_scene(world, dt=dt, num_substeps=num_substeps)
    params, state = make_params(world), make_state(pose, twist)
    wrench = np.zeros((world.num_bodies, 3)) if wrench is None else np.asarray(wrench)
    wrenches = np.broadcast_to(wrench, (num_steps, world.num_bodies, 3))
    pieces = []
    for start in range(0, num_steps, CHUNK):
        chunk = jnp.asarray(wrenches[start : start + CHUNK], float)
        states, info = run_chunk(scene, params, state, chunk, jnp.asarray(dt, float))
        state = jax.tree.map(lambda leaf: leaf[-1], states)
        pieces.append(
            (states.pose, states.twist, info.constraint_error, info.is_finite)
        )
    return Trajectory(*(np.concatenate(parts) for parts in zip(*pieces, strict=True)))


def convergence_orders(errors: list[float]) -> np.ndarray:
    """Order of convergence between runs whose step was halved each time."""
    errors = np.asarray(errors)
    return np.log2(errors[:-1] / errors[1:])
