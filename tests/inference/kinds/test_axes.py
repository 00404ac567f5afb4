"""Drawers of one kind: which way they slide against their own outlines."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.inference import infer_kinds
from boomdp_jax.inference.blocks.block import make_block
from boomdp_jax.inference.kinds.axes import (
    axis_turns,
    measure_from_bodies,
    turned_axes,
)
from boomdp_jax.physics import rollout, scene_spec_from_dict, step
from boomdp_jax.physics.state import state_from_array
from tests.inference.joint_recordings import POSE, UNKNOWN, recorded, scene

DT, NUM_ROWS = 0.05, 40
NOISE = np.array([1e-3, 1e-3, 1e-3, 4e-3, 4e-3, 4e-3])


@pytest.mark.slow
def test_a_drawer_is_the_same_whatever_its_axis_is_measured_from():
    block = make_block(scene(unknown=UNKNOWN), (0,), recorded("drawer"))
    layout = block.layout
    turn = axis_turns(block.target, layout)
    assert np.count_nonzero(turn) == 1
    z = np.random.default_rng(0).normal(size=(20, layout.dim))
    turned, sign = turned_axes(z, turn, layout)
    assert np.any(sign == -1)
    after = measure_from_bodies(block.target, layout).log_likelihood.coordinates
    before = block.target.log_likelihood.coordinates
    active = jnp.asarray(
        [slot.kind in ("prismatic", "ground") for slot in layout.slots]
    )
    state = state_from_array(jnp.asarray([[*POSE, 0.3, -0.2, 0.5]]))

    @jax.jit
    def end(coordinates, point):
        params = coordinates(point, active)
        return step(coordinates.scene, params, state, jnp.ones((1, 3)))[0].array

    for one, other in zip(z, turned, strict=True):
        np.testing.assert_allclose(
            end(before, jnp.asarray(one)), end(after, jnp.asarray(other)), atol=1e-9
        )


def drawers(angles, is_pushed, seed):
    """Boxes that slide along their own x axis, some of which are pulled."""
    rng = np.random.default_rng(seed)
    time = DT * (np.arange(NUM_ROWS) + 0.5)
    bodies, states, wrenches = [], [], []
    for i, (angle, pushed) in enumerate(zip(angles, is_pushed, strict=True)):
        name = f"drawer{i}"
        shape = {"type": "box", "half_extents": [0.25, 0.2]}
        body = {"name": name, "shape": shape, "pose": [2.0 * i, 0.0, angle]}
        body["label"] = "drawer"
        bodies.append(body)
        guide = {"type": "prismatic", "a": name, "b": "world", "axis": angle}
        guide |= {"anchor_a": [0.0, 0.0], "anchor_b": [2.0 * i, 0.0], "angle": angle}
        guide |= {"viscous": 20.0, "dry": 3.0}
        truth = scene_spec_from_dict(
            {
                "schema": "planar-scene-1",
                "dt": DT,
                "bodies": [body | {"density": 30.0}],
                "constraints": [guide],
            }
        )
        way = angle + rng.uniform(-0.6, 0.6)
        push = 25.0 * pushed * np.array([np.cos(way), np.sin(way), 0.05])
        wrench = np.sin(2.0 * np.pi * time)[:, None] * push
        start = truth.initial_state()
        fine = jnp.asarray(np.repeat(wrench, 8, axis=0)[:, None])
        run, _ = rollout(
            truth.scene,
            truth.params(),
            start,
            fine,
            dt=jnp.full(8 * NUM_ROWS, DT / 8),
        )
        path = np.concatenate([start.array[None], run.array[7::8]])[:, 0]
        states.append(path + NOISE * rng.standard_normal(path.shape))
        wrenches.append(wrench)
    state, wrench = np.stack(states, axis=1), np.stack(wrenches, axis=1)
    unknown = {"revolute": 1, "prismatic": 1, "ground": 1}
    spec = scene_spec_from_dict(
        {"schema": "planar-scene-1", "dt": DT, "bodies": bodies, "unknown": unknown}
    )
    return spec, make_history(state[:-1], wrench, state[1:], DT)


@pytest.mark.slow
def test_a_drawer_that_nobody_pulled_slides_as_the_others_of_its_kind_do():
    angles = np.array([1.0, 1.0 + np.pi / 2, 2.6, 0.2])
    spec, history = drawers(angles, [1, 1, 0, 0], seed=2)
    posterior = infer_kinds(jax.random.key(2), spec, history).posterior
    guide = posterior.params.prismatic
    for body in (2, 3):
        (slot,) = np.flatnonzero(np.asarray(guide.body_a)[0] == body)
        is_drawer = np.asarray(guide.active[:, slot])
        assert is_drawer.mean() > 0.7
        off = np.asarray(guide.axis[:, slot])[is_drawer] - angles[body]
        off -= np.pi * np.round(off / np.pi)
        assert abs(np.median(off)) < 0.05
        assert np.mean(np.abs(off) < 0.2) > 0.8


@pytest.mark.slow
def test_noise_of_the_motion_is_among_what_is_inferred_with_kinds():
    """A free box, kicked before each step: a fresh recording is as far off as told."""
    kick = np.array([0.03, 0.03, 0.08])
    body = {"name": "box", "shape": {"type": "box", "half_extents": [0.3, 0.2]}}
    content = {"schema": "planar-scene-1", "gravity": [0.0, 0.0], "dt": 0.04}
    truth = scene_spec_from_dict({**content, "bodies": [body | {"density": 20.0}]})
    unknown = {"revolute": 1, "wheel": 1, "ground": 1}
    spec = scene_spec_from_dict({**content, "bodies": [body], "unknown": unknown})
    params = truth.params()
    move = jax.jit(lambda state, wrench: step(truth.scene, params, state, wrench)[0])

    def history(seed):
        rng = np.random.default_rng(seed)
        wrench = np.repeat(rng.uniform(-1, 1, (10, 3)), 6, axis=0) * [14.0, 14.0, 2.0]
        now, path = np.zeros((1, 6)), [np.zeros((1, 6))]
        for push in wrench:
            now = now + np.append(np.zeros(3), kick * rng.standard_normal(3))
            now = np.asarray(move(state_from_array(jnp.asarray(now)), push[None]).array)
            path.append(now)
        state = np.stack(path) + NOISE * rng.standard_normal((61, 1, 6))
        return make_history(state[:-1], wrench[:, None], state[1:], 0.04)

    posterior = infer_kinds(jax.random.key(0), spec, history(1)).posterior
    found = np.median(np.asarray(posterior.impulse_scale)[:, 0], axis=0)
    np.testing.assert_allclose(found, kick[1:], rtol=0.3)
    (told,) = posterior.predict(history(2), [10])["horizons"].values()
    # 51 starts that overlap: under ten independent ones; half would be ten sd away.
    assert all(channel["coverage90"] > 0.6 for channel in told.values())
