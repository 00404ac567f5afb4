"""Worlds that models learn: a cart in the open, and random transitions of it."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.physics import State, rollout, scene_spec_from_dict


def cart(*, walls: bool = False):
    """A box with a wheel at one end; with walls, a static box on its left."""
    bodies = [
        {
            "name": "cart",
            "pose": [0.0, 0.0, 0.0],
            "shape": {"type": "box", "half_extents": [0.5, 0.28]},
            "density": 10.0,
        }
    ]
    if walls:
        wall = {
            "name": "wall",
            "static": True,
            "pose": [0.0, 2.0, 0.0],
            "shape": {"type": "box", "half_extents": [3.0, 0.1]},
        }
        bodies.append(wall)
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, 0.0],
            "dt": 0.1,
            "bodies": bodies,
            "constraints": [
                {
                    "type": "wheel",
                    "a": "cart",
                    "pose": [-0.4, 0.0, 0.0],
                    "viscous": [30.0, 600.0],
                }
            ],
        }
    )


def ride(num_steps: int, seed: int = 0):
    """Rows of a cart under random forces: states, wrenches, next states, `[time]`."""
    # A test in single precision must not leave its rows to one in double.
    return _ride(num_steps, seed, jnp.zeros(()).dtype.name)


@functools.cache
def _ride(num_steps: int, seed: int, dtype: str):
    del dtype  # Only a part of the key: the default of the moment.
    spec = cart()
    rng = np.random.default_rng([31, seed])
    force = np.repeat(rng.normal(size=(num_steps // 4 + 1, 1, 3)), 4, axis=0)
    wrench = jnp.asarray(30.0 * force[:num_steps] * np.array([1.0, 1.0, 0.3]), float)
    start = spec.initial_state()
    after, _ = jax.jit(rollout)(spec.scene, spec.params(), start, wrench)
    before = jax.tree.map(
        lambda first, rest: jnp.concatenate([first[None], rest[:-1]]), start, after
    )
    return before, wrench, after


@eqx.filter_jit
def learn(model, rows, key=None):
    """All rows, one after the other, in one compiled loop."""
    key = jax.random.key(0) if key is None else key

    def take(learnt, row):
        return model.update(learnt, *row), None

    return jax.lax.scan(take, model.init(key), rows)[0]


@eqx.filter_jit
def expected(model, learnt, rows, key=None) -> State:
    """What the first hypothesis expects of every row."""
    key = jax.random.key(1) if key is None else key
    before, wrench, _ = rows
    hypothesis = model.sample(key, learnt, 1)[0]
    return jax.vmap(lambda s, w: model.transition(key, hypothesis, s, w))(
        before, wrench
    )


def only(rows, num: int):
    """The same rows, none of them read but the first few."""
    before, wrench, after = rows
    is_read = jnp.arange(len(wrench)) < num
    pose = jnp.where(is_read[:, None, None], after.pose, jnp.nan)
    return before, wrench, State(pose, after.twist)


def part(rows, start: int, stop: int):
    """Some of the rows."""
    return jax.tree.map(lambda leaf: leaf[start:stop], rows)


def error_share(model, learnt, rows) -> np.ndarray:
    """Root mean square error of six numbers over that of coasting, over all bodies."""
    before, _, after = rows
    coast = State(before.pose + 0.1 * before.twist, before.twist)
    missed = np.asarray((expected(model, learnt, rows).array - after.array) ** 2)
    least = np.asarray((coast.array - after.array) ** 2)
    return np.sqrt(missed.mean((0, 1)) / least.mean((0, 1)))
