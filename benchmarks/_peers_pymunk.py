"""pymunk (Chipmunk 7): a loop over worlds on one core.

Ten iterations, no sleep (defaults). Its slop of 0.1 is meant for pixels; here it is
2 mm, as if a metre were fifty of them. Coefficients of two shapes are multiplied, so
each gets the root. A pin is a `PivotJoint`; friction on the floor of a scene seen from
above is its usual recipe, a pivot and a gear with limited force and no position
correction.
"""

import math

import numpy as np
import pymunk
from _peers_program import NotExpressibleError, Peer, Program, mean_arm

from boomdp_jax.physics.params import WORLD

SLOP = 0.002


def _space(spec, start: np.ndarray) -> tuple[pymunk.Space, list[pymunk.Body]]:
    space = pymunk.Space()
    space.gravity = tuple(spec.gravity)
    space.collision_slop = SLOP
    bodies = []
    for body, state in zip(spec.bodies, start, strict=True):
        kind = pymunk.Body.STATIC if body.is_static else pymunk.Body.DYNAMIC
        mass = 0.0 if body.is_static else body.density * body.area
        made = pymunk.Body(mass, mass * body.gyration, body_type=kind)
        made.position, made.angle = tuple(state[:2]), state[2]
        if not body.is_static:
            made.velocity, made.angular_velocity = tuple(state[3:5]), state[5]
        space.add(made)
        bodies.append(made)
        if body.friction is not None:
            shape = (
                pymunk.Circle(made, body.radius)
                if body.kind == "circle"
                else pymunk.Poly(made, body.vertices.tolist())
            )
            shape.friction = math.sqrt(body.friction)
            shape.elasticity = math.sqrt(body.restitution or 0.0)
            space.add(shape)
    for constraint in spec.constraints:
        space.add(*_joints(spec, constraint, space, bodies))
    return space, bodies


def _joints(spec, constraint, space, bodies) -> list[pymunk.Constraint]:
    own, numbers = bodies[constraint.body_a], constraint.numbers
    if constraint.kind == "revolute":
        is_world = constraint.body_b == WORLD
        other = space.static_body if is_world else bodies[constraint.body_b]
        anchors = tuple(numbers["anchor_a"]), tuple(numbers["anchor_b"])
        return [pymunk.PivotJoint(own, other, *anchors)]
    if constraint.kind == "ground":
        body = spec.bodies[constraint.body_a]
        limit = float(numbers["dry"]) * own.mass * spec.normal_gravity
        slide = pymunk.PivotJoint(space.static_body, own, (0, 0), (0, 0))
        turn = pymunk.GearJoint(space.static_body, own, 0.0, 1.0)
        slide.max_force = limit
        turn.max_force = limit * mean_arm(body)
        slide.max_bias = turn.max_bias = 0.0
        return [slide, turn]
    raise NotExpressibleError(f"no {constraint.kind}")


def _state(bodies: list[pymunk.Body]) -> list[list[float]]:
    return [
        [*body.position, body.angle, *body.velocity, body.angular_velocity]
        for body in bodies
    ]


def _prepare(spec, starts: np.ndarray, num_steps: int) -> Program:
    worlds: list[tuple[pymunk.Space, list[pymunk.Body]]] = []
    dt = spec.dt

    def reset():
        worlds[:] = [_space(spec, start) for start in starts]

    def run():
        for space, _ in worlds:
            for _ in range(num_steps):
                space.step(dt)

    def states():
        path = np.zeros((len(starts), num_steps, spec.num_bodies, 6))
        for i, start in enumerate(starts):
            space, bodies = _space(spec, start)
            for k in range(num_steps):
                space.step(dt)
                path[i, k] = _state(bodies)
        return path

    reset()
    return Program(run, states, reset)


PEERS = (Peer("pymunk", _prepare),)
