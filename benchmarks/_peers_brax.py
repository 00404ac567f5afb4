"""Brax's own pipelines, generalized and spring: MuJoCo's hinge scenes, no equalities.

Generalized: time step 1/60 s; four substeps where bodies touch, without which a pile of
boxes explodes. Spring: joints are springs that 1/60 s cannot resolve; four substeps,
the 4 to 5 ms of its environments, and the stiffness of its half-cheetah. All else as by
default. Frames are at the hinges, as Brax takes no account of an offset. Neither has an
actuator on a body-fixed site, so no wheel.
"""

import jax
import jax.numpy as jnp
import numpy as np
from _peers_mjcf import mujoco_world
from _peers_program import NotExpressibleError, Peer, Program, compiled_program
from brax import com
from brax.generalized import pipeline as generalized
from brax.io import mjcf
from brax.spring import pipeline as spring

NUM_SUBSTEPS = 4


def _prepare(pipeline, is_always_fine: bool):
    def prepare(spec, starts: np.ndarray, num_steps: int) -> Program:
        if any(constraint.kind == "wheel" for constraint in spec.constraints):
            raise NotExpressibleError("actuators on joints only, no wheel")
        can_touch = any(body.friction is not None for body in spec.bodies)
        num_substeps = NUM_SUBSTEPS if is_always_fine or can_touch else 1
        world = mujoco_world(spec, integrator="Euler", num_substeps=num_substeps)
        system = mjcf.loads(world.text)
        action = jnp.zeros(0)

        def one_world(position, velocity):
            def advance(state, _):
                state = jax.lax.fori_loop(
                    0,
                    num_substeps,
                    lambda _, state: pipeline.step(system, state, action),
                    state,
                )
                place, rate = com.from_world(system, state.x, state.xd)
                turn = 2.0 * jnp.arctan2(place.rot[:, 3], place.rot[:, 0])
                own = [place.pos[:, :2], turn, rate.vel[:, :2], rate.ang[:, 2]]
                return state, jnp.column_stack(own)

            start = pipeline.init(system, position, velocity)
            return jax.lax.scan(advance, start, None, length=num_steps)[1]

        arguments = tuple(
            jnp.asarray(part, jnp.float32) for part in world.to_joints(starts)
        )
        order = [link.body for link in world.links]

        def read(path):
            static = np.asarray(starts, float)[:, None]
            states = np.repeat(static, num_steps, axis=1)
            states[:, :, order] = path
            return states

        return compiled_program(jax.vmap(one_world), arguments, read)

    return prepare


PEERS = (
    Peer("Brax generalized", _prepare(generalized, False), ()),
    Peer("Brax spring", _prepare(spring, True), ()),
)
