"""Scenes with contact, as a user writes them, and a rollout that compiles once."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.physics import rollout, scene_spec_from_dict

CHUNK = 60
"""Steps in one compiled call; longer runs repeat it."""


def body(name, shape, pose, twist=(0, 0, 0), *, friction=0.5, restitution=0.0, **more):
    """An entry of `bodies`: a pair of half extents is a box, a number a disc."""
    if isinstance(shape, tuple):
        outline = {"type": "box", "half_extents": list(shape)}
    elif isinstance(shape, list):
        outline = {"type": "polygon", "vertices": shape}
    else:
        outline = {"type": "circle", "radius": shape}
    entry = {
        "name": name,
        "shape": outline,
        "pose": list(pose),
        "twist": list(twist),
        "contact": {"friction": friction, "restitution": restitution},
        "density": 20.0,
    }
    return {**entry, **more}


def fixed(name, shape, pose, **more):
    """A static body."""
    return body(name, shape, pose, static=True, **more)


FLOOR = fixed("floor", (20.0, 0.5), (0.0, -0.5, 0.0))


def spec_of(*bodies, gravity=(0.0, -9.81), dt=1 / 60, constraints=(), **more):
    """A scene of these bodies."""
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": list(gravity),
            "dt": dt,
            "bodies": list(bodies),
            "constraints": list(constraints),
            **more,
        }
    )


class _Moment(NamedTuple):
    """A state in NumPy."""

    pose: np.ndarray
    twist: np.ndarray


@functools.partial(jax.jit, static_argnames=("num",))
def _chunk(scene, params, state, wrench, num):
    wrenches = jnp.broadcast_to(wrench, (num, *wrench.shape))
    return rollout(scene, params, state, wrenches)


def run(spec, num_steps, wrench=None):
    """States after each step, their reports, and the state at the end."""
    scene, params, state = spec.scene, spec.params(), spec.initial_state()
    wrench = jnp.zeros_like(state.pose) if wrench is None else jnp.asarray(wrench)
    states, reports = [], []
    for _ in range(-(-num_steps // CHUNK)):
        after, report = _chunk(scene, params, state, wrench, CHUNK)
        states.append(after)
        reports.append(report)
        state = jax.tree.map(lambda leaf: leaf[-1], after)
    joined = [
        jax.tree.map(lambda *leaves: np.concatenate(leaves)[:num_steps], *parts)
        for parts in (states, reports)
    ]
    return joined[0], joined[1], _Moment(joined[0].pose[-1], joined[0].twist[-1])
