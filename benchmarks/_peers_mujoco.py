"""MuJoCo in C: `mujoco.rollout`, one data object and one lasting thread a core.

`implicitfast`, time step 1/60 s, Newton's method with the default tolerance and at most
100 iterations, default contact softness (MuJoCo itself raises its time constant of 20
ms to two steps). A rollout returns every state.
"""

import os

import mujoco
import mujoco.rollout
import numpy as np
from _peers_mjcf import mujoco_world
from _peers_program import Peer, Program


def _prepare(pin: str):
    def prepare(spec, starts: np.ndarray, num_steps: int) -> Program:
        world = mujoco_world(spec, pin=pin)
        model = mujoco.MjModel.from_xml_string(world.text)
        num_threads = os.cpu_count() or 1
        workers = [mujoco.MjData(model) for _ in range(num_threads)]
        pool = mujoco.rollout.Rollout(nthread=num_threads)
        size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        start = np.zeros((len(starts), size))
        position, velocity = world.to_joints(starts)
        start[:, 1 : 1 + model.nq] = position
        start[:, 1 + model.nq : 1 + model.nq + model.nv] = velocity

        def run():
            return pool.rollout(model, workers, start, nstep=num_steps)[0]

        def states():
            path = run()
            return world.to_states(
                path[..., 1 : 1 + model.nq],
                path[..., 1 + model.nq : 1 + model.nq + model.nv],
            )

        return Program(run, states)

    return prepare


PEERS = (
    Peer("MuJoCo C, hinge", _prepare("hinge")),
    Peer("MuJoCo C, equality", _prepare("connect")),
)
