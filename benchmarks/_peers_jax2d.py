"""Jax2D, a solver of Box2D's kind in JAX: `vmap` over worlds.

Ten solver iterations, warm starting and all coefficients as by default; its slop is
1 cm. Capacities are just what a scene needs, plus two idle circles, without which it
does not trace. Friction of a pair is 0.4 times the norm of both values, restitution
their product.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from _peers_program import NotExpressibleError, Peer, Program, compiled_program
from jax2d.engine import PhysicsEngine, create_empty_sim
from jax2d.scene import add_polygon_to_scene, add_revolute_joint_to_scene
from jax2d.sim_state import SimParams, StaticSimParams

from boomdp_jax.physics.params import WORLD

NUM_CIRCLES = 2
_OWN_FRICTION = 0.4 * math.sqrt(2.0)
"""What two equal values of one are worth."""


def _build(spec):
    """Empty worlds' static sizes and one world with its bodies, joints and walls."""
    pins = [c for c in spec.constraints if c.kind == "revolute"]
    for constraint in spec.constraints:
        if constraint.kind != "revolute":
            raise NotExpressibleError(f"no {constraint.kind}")
    order = np.argsort([not body.is_static for body in spec.bodies], kind="stable")
    num_static = sum(body.is_static for body in spec.bodies)
    is_pinned = any(pin.body_b == WORLD for pin in pins)
    sizes = StaticSimParams(
        num_polygons=max(spec.num_bodies + is_pinned, 2),
        num_circles=NUM_CIRCLES,
        num_joints=max(len(pins), 1),
        num_thrusters=1,
        num_static_fixated_polys=num_static,
    )
    state = create_empty_sim(sizes, add_floor=False, add_walls_and_ceiling=False)
    index = {}
    for i in order:
        body = spec.bodies[i]
        if body.kind != "box":
            raise NotExpressibleError("only boxes are translated")
        state, (index[int(i)], _) = add_polygon_to_scene(
            state,
            sizes,
            jnp.zeros(2) if body.pose is None else jnp.asarray(body.pose[:2]),
            jnp.asarray(body.vertices[::-1].copy()),
            len(body.vertices),
            density=1.0 if body.density is None else body.density,
            friction=(body.friction or 0.0) / _OWN_FRICTION,
            restitution=math.sqrt(body.restitution or 0.0),
            fixated=body.is_static,
        )
    if is_pinned:
        far = jnp.array([0.0, -10.0])
        corners = 0.1 * jnp.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
        state, (index[WORLD], _) = add_polygon_to_scene(
            state, sizes, far, corners, 4, fixated=True
        )
    for pin in pins:
        shift = jnp.asarray([0.0, 10.0 if pin.body_b == WORLD else 0.0])
        state, _ = add_revolute_joint_to_scene(
            state,
            sizes,
            index[pin.body_a],
            index[pin.body_b],
            jnp.asarray(pin.numbers["anchor_a"]),
            jnp.asarray(pin.numbers["anchor_b"]) + shift,
        )
    places = np.array([int(index[i]) for i in range(spec.num_bodies)])
    return sizes, state.replace(gravity=jnp.asarray(spec.gravity)), places


def _prepare(spec, starts: np.ndarray, num_steps: int) -> Program:
    sizes, blank, places = _build(spec)
    engine = PhysicsEngine(sizes)
    settings = SimParams(dt=spec.dt)
    action = jnp.zeros(sizes.num_joints + sizes.num_thrusters)

    def one_world(start):
        polygon = blank.polygon.replace(
            position=blank.polygon.position.at[places].set(start[:, :2]),
            rotation=blank.polygon.rotation.at[places].set(start[:, 2]),
            velocity=blank.polygon.velocity.at[places].set(start[:, 3:5]),
            angular_velocity=blank.polygon.angular_velocity.at[places].set(start[:, 5]),
        )

        def advance(state, _):
            state, _ = engine.step(state, settings, action)
            own = jax.tree.map(lambda leaf: leaf[places], state.polygon)
            columns = own.position, own.rotation, own.velocity, own.angular_velocity
            return state, jnp.column_stack(columns)

        start_state = blank.replace(polygon=polygon)
        return jax.lax.scan(advance, start_state, None, length=num_steps)[1]

    return compiled_program(
        jax.vmap(one_world),
        (jnp.asarray(starts, jnp.float32),),
        lambda path: np.asarray(path, float),
    )


PEERS = (Peer("Jax2D", _prepare, ()),)
