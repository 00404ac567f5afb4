"""Newton's method for worlds of joints, of which a batch is solved at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics import State, rollout, scene_spec_from_dict, velocity_search
from boomdp_jax.physics.general_step import velocity_problem
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.prepare import prepare_world

NUM_WORLDS, NUM_BODIES = 208, 2


def pair(rng) -> dict:
    """Two boxes on a pin with friction, each on a wheel and a floor."""
    names = [f"box {i}" for i in range(NUM_BODIES)]
    shape = {"type": "box", "half_extents": [0.25, 0.15]}
    pin = {
        "type": "revolute",
        "a": names[0],
        "b": names[1],
        "dry": rng.exponential(0.5),
    }
    constraints = [pin | {"anchor_a": [0.3, 0.0], "anchor_b": [-0.3, 0.0]}]
    for name in names:
        constraints.append({"type": "ground", "a": name, "dry": rng.exponential(0.3)})
        wheel = {"pose": [0.1 * rng.normal(), 0.0, rng.normal()]}
        wheel |= {"viscous": [1.0, np.exp(rng.normal(3.0, 1.0))]}
        wheel |= {"dry": [0.05, rng.exponential(5.0)]}
        constraints.append({"type": "wheel", "a": name} | wheel)
    bodies = [
        {"name": name, "shape": shape, "pose": [0.6 * i, 0.0, 0.0]}
        | {"density": np.exp(rng.normal(3.5, 1.0))}
        for i, name in enumerate(names)
    ]
    scene = {"schema": "planar-scene-1", "dt": 0.02, "bodies": bodies}
    return jax.tree.map(
        lambda leaf: float(leaf) if isinstance(leaf, np.floating) else leaf,
        scene | {"constraints": constraints},
    )


@pytest.fixture(autouse=True)
def single_precision():
    with jax.enable_x64(False):
        yield


@pytest.fixture
def worlds(single_precision):
    """Scene, params with a leading axis, twists and wrenches `[world, body, 3]`."""
    rng = np.random.default_rng(0)
    specs = [scene_spec_from_dict(pair(rng)) for _ in range(NUM_WORLDS)]
    params = jax.tree.map(
        lambda *leaves: jnp.stack(leaves), *(s.params() for s in specs)
    )
    pose = specs[0].initial_state().pose
    shape = (NUM_WORLDS, NUM_BODIES, 3)
    twist = jnp.asarray(rng.normal(size=shape) * [0.5, 0.5, 1.0], pose.dtype)
    wrench = jnp.asarray(rng.normal(size=shape) * [15.0, 15.0, 2.0], pose.dtype)
    return specs[0].scene, params, pose, twist, wrench


@pytest.mark.slow
def test_steps_that_the_line_tells_nothing_of_are_taken_whole(worlds, monkeypatch):
    """Six iterations beyond the first ones will do, where there are no later ones.

    What joints do works a little where they turn, and along the last steps there is
    nothing but rounding: those that ended where the start was went on for good.
    """
    monkeypatch.setattr(velocity_search, "_NUM_LINES", 6)
    monkeypatch.setattr(velocity_search, "NUM_LATE", (0, 0, 0))
    scene, params, pose, twist, wrench = worlds

    def lanes(tree):
        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), tree)

    def spread(leaf):
        return jnp.broadcast_to(leaf, (NUM_WORLDS, *jnp.shape(leaf)))

    @jax.jit
    def is_settled(twist, wrench):
        length = jnp.full(NUM_WORLDS, 0.02, pose.dtype)
        scenes = lanes(jax.tree.map(spread, scene))
        prepared = prepare_world(scenes, lanes(params), length)
        channels = jnp.concatenate([spread(pose), twist], axis=-1)
        motion = Motion(*(lanes(channels[..., i]) for i in range(6)))
        force = tuple(lanes(wrench[..., i]) for i in range(3))
        problem = velocity_problem(prepared, motion, force)
        found = velocity_search.solve_velocity(problem)
        again = velocity_search.newton_step(problem, found.solution).solution
        return found.is_settled, jnp.abs(again.twist[0] - found.solution.twist[0])

    for turn in range(10):
        settled, left = is_settled(jnp.roll(twist, turn, axis=0), wrench)
        assert bool(jnp.all(settled))
        assert float(jnp.max(left)) < 1e-6


@pytest.mark.slow
def test_the_rest_of_a_batch_changes_no_bit(worlds):
    scene, params, pose, twist, wrench = worlds

    @jax.jit
    def run(params, twist, wrench):
        def one(params, twist, wrench):
            wrenches = jnp.broadcast_to(wrench, (5, *wrench.shape))
            return rollout(scene, params, State(pose, twist), wrenches)[0].array

        return jax.vmap(one)(params, twist, wrench)

    given = params, twist, wrench
    order = np.random.default_rng(1).permutation(NUM_WORLDS)
    whole = run(*given)
    turned = run(*jax.tree.map(lambda leaf: leaf[order], given))
    np.testing.assert_array_equal(turned, whole[order])
    # The first eight with others beside them, all like the first.
    few = np.where(np.arange(NUM_WORLDS) < 8, np.arange(NUM_WORLDS), 0)
    beside = run(*jax.tree.map(lambda leaf: leaf[few], given))
    np.testing.assert_array_equal(beside, whole[few])
