"""What the engine says to states, wrenches and noise of the wrong shape."""

import dataclasses
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics import State, scene_spec_from_dict
from boomdp_jax.physics.arguments import (
    check_world,
    checked_length,
    checked_state,
    checked_wrench,
    checked_wrenches,
)


@pytest.mark.parametrize("shape", [(5, 1, 3), (5, 3), (5, 2, 2), (5, 3, 3), (3,)])
def test_wrenches_on_other_bodies_are_refused(shape):
    """One row for two bodies would push them both."""
    with pytest.raises(
        ValueError, match=r"wrenches: expected shape \(time, 2, 3\), .* got"
    ):
        checked_wrenches(2, np.zeros(shape))


@pytest.mark.parametrize("shape", [(1, 3), (3,), (2, 2), (5, 2, 3)])
def test_a_wrench_on_other_bodies_is_refused(shape):
    with pytest.raises(ValueError, match=r"wrench: expected shape \(2, 3\)"):
        checked_wrench(2, np.zeros(shape))


def test_a_state_of_other_bodies_is_refused():
    one = State(jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"state\.pose: .*\(2, 3\), .* got \(1, 3\)"):
        checked_state(2, one)
    with pytest.raises(TypeError, match=r"state: expected a State, got ndarray"):
        checked_state(2, np.zeros((2, 6)))


def test_lengths_are_one_or_one_for_each_step():
    for dt in (0.02, np.full(4, 0.02)):
        assert checked_length(dt, 4, jnp.float32).shape == np.shape(dt)
    with pytest.raises(ValueError, match=r"dt: .* each of 4 steps; got shape \(3,\)"):
        checked_length(np.full(3, 0.02), 4, jnp.float32)


def test_whole_numbers_are_floats():
    made = np.zeros((2, 3)).astype(int)
    assert checked_wrench(2, [[3, 0, 0]] * 2).dtype == float
    whole = object.__new__(State)
    for name in ("pose", "twist"):
        object.__setattr__(whole, name, made)
    assert checked_state(2, whole).array.dtype == float


def test_slots_of_other_bodies_and_batches_of_them_are_refused():
    spec = scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": 0.02,
            "bodies": [
                {"name": name, "shape": {"type": "circle", "radius": 0.1}, "density": 9}
                for name in "ab"
            ],
            "constraints": [
                {"type": "revolute", "a": "a", "b": "world"}
                | {"anchor_a": [0.0, 0.0], "anchor_b": [0.0, 0.0]},
                {"type": "ground", "a": "b", "dry": 0.1},
            ],
        }
    )
    params = spec.params()
    check_world(spec.scene, params)
    one = jax.tree.map(lambda leaf: leaf[:1], params.ground)
    mixed = dataclasses.replace(params, ground=one)
    expected = r"params\.ground\.active: .* \(2, slots\) in .* 2 bodies, got \(1, 1\)"
    with pytest.raises(ValueError, match=expected):
        check_world(spec.scene, mixed)
    many = jax.tree.map(lambda leaf: leaf[None], params.revolute)
    expected = r"params\.revolute\.active: .* \(slots,\), got \(1, 1\); jax\.vmap"
    with pytest.raises(ValueError, match=expected):
        check_world(spec.scene, dataclasses.replace(params, revolute=many))


# As users call the engine: without the checks of types that tests run under.
PROGRAM = """
import jax, numpy as np
from boomdp_jax.physics import *
box = {"type": "box", "half_extents": [0.2, 0.1]}
bodies = [
    {"name": n, "shape": box, "pose": [x, 0, 0], "density": 9}
    for x, n in enumerate("ab")
]
spec = scene_spec_from_dict({"schema": "planar-scene-1", "dt": 0.02, "bodies": bodies})
world = spec.scene, spec.params(), spec.initial_state()
def noise(*observation):
    return SimulationNoise(np.zeros(3), np.array(observation))
quiet = noise(0.0, 0, 0, 0)
key, wrenches = jax.random.key(0), np.zeros((4, 2, 3))
scene, params, state = world
lone = scene_spec_from_dict(
    {"schema": "planar-scene-1", "dt": 0.02, "bodies": bodies[:1]}
)
many = jax.tree.map(lambda leaf: leaf[None], params)
for call in (
    lambda: step(spec, params, state, wrenches[0]),
    lambda: step(params, scene, state, wrenches[0]),
    lambda: rollout(scene, spec, state, wrenches),
    lambda: prepare_step(scene, lone.params()),
    lambda: step(lone.scene, params, lone.initial_state(), wrenches[0, :1]),
    lambda: rollout(scene, many, state, wrenches),
    lambda: step(jax.tree.map(lambda leaf: leaf[None], scene), *world[1:], wrenches[0]),
    lambda: step(*world, np.zeros((1, 3))),
    lambda: rollout(*world, np.zeros((4, 1, 3))),
    lambda: rollout(*world, wrenches, dt=np.full(3, 0.02)),
    lambda: rollout(*world, wrenches, dt=-0.02),
    lambda: step(*world, wrenches[0], dt=np.full(3, 0.02)),
    lambda: step(*world, wrenches[0], dt=-0.02),
    lambda: rollout(*world[:2], np.zeros((2, 6)), wrenches),
    lambda: simulate(key, *world, np.zeros((4, 1, 3)), quiet),
    lambda: simulate(key, *world, wrenches, noise(0.0, 0, 0)),
    lambda: simulate(key, *world, wrenches, noise(0.0, 0, 0, -1)),
    lambda: simulate(key, *world, wrenches, noise(0.0, 0, 0, np.nan)),
):
    try:
        call()
    except (TypeError, ValueError) as error:
        print(error)
"""


def test_the_engine_names_what_is_wrong():
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True
    )
    expected = (
        "scene: expected a Scene, got SceneSpec; its .scene is one",
        "scene: expected a Scene, got Params",
        "params: expected Params, got SceneSpec",
        "params.density: expected shape (2,) in a scene of 2 bodies, got (1,)",
        "params.density: expected shape (1,) in a scene of 1 body, got (2,)",
        "params.density: expected shape (2,) in a scene of 2 bodies, got (1, 2); "
        "jax.vmap goes over a batch of hypotheses",
        "scene: expected one, got a batch of shape (1,); jax.vmap",
        "wrench: expected shape (2, 3)",
        "wrenches: expected shape (time, 2, 3)",
        "dt: expected one number, or one for each of 4 steps",
        "dt: expected at least 0 s",
        "dt: expected one number; got shape (3,)",
        "dt: expected at least 0 s",
        "state: expected a State",
        "wrenches: expected shape (time, 2, 3)",
        "noise.observation: expected shape (4,), of position",
        "noise.observation: expected standard deviations of at least 0",
        "noise.observation: expected standard deviations of at least 0",
    )
    lines = [line for line in result.stdout.splitlines() if ": expected" in line]
    assert len(lines) == len(expected), result.stdout
    for line, start in zip(lines, expected, strict=True):
        assert line.startswith(start)
