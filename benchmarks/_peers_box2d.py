"""Box2D 2.3: a loop over worlds on one core.

Eight velocity and three position iterations (its manual's), warm starting, no sleep.
Friction of a pair is the geometric mean, restitution the larger one, and none below an
approach of 1 m/s. Polygons have a skin of 1 cm and rest 1.5 cm apart; outlines are
drawn in by half of that, so that what is compared touches. A pin is a revolute joint;
friction on the floor of a scene seen from above is a friction joint, whose force and
torque have separate limits.
"""

import numpy as np
from _peers_program import NotExpressibleError, Peer, Program, mean_arm
from Box2D import (
    b2_linearSlop,
    b2_polygonRadius,
    b2CircleShape,
    b2MassData,
    b2PolygonShape,
    b2World,
)

from boomdp_jax.physics.params import WORLD

VELOCITY_ITERATIONS, POSITION_ITERATIONS = 8, 3
INSET = b2_polygonRadius - 0.5 * b2_linearSlop
"""How far outlines are drawn in [m]."""


def _world(spec, start: np.ndarray):
    world = b2World(gravity=tuple(map(float, spec.gravity)), doSleep=False)
    bodies = []
    for body, state in zip(spec.bodies, start.tolist(), strict=True):
        place = {"position": state[:2], "angle": state[2]}
        if body.is_static:
            made = world.CreateStaticBody(**place)
        else:
            made = world.CreateDynamicBody(
                **place,
                linearVelocity=state[3:5],
                angularVelocity=state[5],
                allowSleep=False,
            )
        bodies.append(made)
        if body.friction is not None:
            made.CreateFixture(
                shape=_shape(body),
                density=body.density or 0.0,
                friction=body.friction,
                restitution=body.restitution or 0.0,
            )
        if not body.is_static:
            mass = body.density * body.area
            made.massData = b2MassData(
                mass=mass, center=(0.0, 0.0), I=mass * body.gyration
            )
    base = world.CreateStaticBody()
    for constraint in spec.constraints:
        _add_joint(world, spec, constraint, base, bodies)
    return world, bodies


def _shape(body):
    if body.kind == "circle":
        return b2CircleShape(radius=body.radius)
    if body.kind != "box":
        raise NotExpressibleError("only boxes are drawn in by the skin")
    vertices = body.vertices - INSET * np.sign(body.vertices)
    return b2PolygonShape(vertices=vertices.tolist())


def _add_joint(world, spec, constraint, base, bodies) -> None:
    own, numbers = bodies[constraint.body_a], constraint.numbers
    if constraint.kind == "revolute":
        is_world = constraint.body_b == WORLD
        world.CreateRevoluteJoint(
            bodyA=own,
            bodyB=base if is_world else bodies[constraint.body_b],
            localAnchorA=numbers["anchor_a"].tolist(),
            localAnchorB=numbers["anchor_b"].tolist(),
        )
    elif constraint.kind == "ground":
        body = spec.bodies[constraint.body_a]
        limit = float(numbers["dry"]) * own.mass * spec.normal_gravity
        world.CreateFrictionJoint(
            bodyA=base,
            bodyB=own,
            localAnchorA=(0.0, 0.0),
            localAnchorB=(0.0, 0.0),
            maxForce=limit,
            maxTorque=limit * mean_arm(body),
        )
    else:
        raise NotExpressibleError(f"no {constraint.kind}")


def _state(bodies) -> list[list[float]]:
    return [
        [*body.position, body.angle, *body.linearVelocity, body.angularVelocity]
        for body in bodies
    ]


def _prepare(spec, starts: np.ndarray, num_steps: int) -> Program:
    worlds: list = []
    iterations = VELOCITY_ITERATIONS, POSITION_ITERATIONS
    dt = spec.dt

    def reset():
        worlds[:] = [_world(spec, start) for start in starts]

    def run():
        for world, _ in worlds:
            for _ in range(num_steps):
                world.Step(dt, *iterations)
                world.ClearForces()

    def states():
        path = np.zeros((len(starts), num_steps, spec.num_bodies, 6))
        for i, start in enumerate(starts):
            world, bodies = _world(spec, start)
            for k in range(num_steps):
                world.Step(dt, *iterations)
                world.ClearForces()
                path[i, k] = _state(bodies)
        return path

    reset()
    return Program(run, states, reset)


PEERS = (Peer("Box2D", _prepare),)
