"""MJX, MuJoCo's rewrite in JAX: the scenes that MuJoCo gets, `vmap` over worlds.

`implicitfast`, time step 1/60 s; Newton's method with at most 20 iterations and 20 of
its line search (with 4 and 8, which its guide has for speed, a pile of boxes ends as
NaN). Of ten boxes it keeps the nearest 30 pairs and 120 contacts, or every pair that
might touch would cost its constraint rows.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from _peers_mjcf import mujoco_world
from _peers_program import Peer, Program, compiled_program
from mujoco import mjx


def _prepare(pin: str):
    def prepare(spec, starts: np.ndarray, num_steps: int) -> Program:
        world = mujoco_world(spec, pin=pin)
        host = mujoco.MjModel.from_xml_string(world.text)
        host.opt.iterations, host.opt.ls_iterations = 20, 20
        model = mjx.put_model(host)
        blank = mjx.make_data(model)

        def one_world(position, velocity):
            def advance(data, _):
                data = mjx.step(model, data)
                return data, (data.qpos, data.qvel)

            start = blank.replace(qpos=position, qvel=velocity)
            return jax.lax.scan(advance, start, None, length=num_steps)[1]

        arguments = tuple(
            jnp.asarray(part, jnp.float32) for part in world.to_joints(starts)
        )
        return compiled_program(
            jax.vmap(one_world),
            arguments,
            lambda path: world.to_states(*(np.asarray(part, float) for part in path)),
        )

    return prepare


PEERS = (
    Peer("MJX, hinge", _prepare("hinge"), ("pendulum, 300 steps",)),
    Peer("MJX, equality", _prepare("connect"), ()),
)
