"""Joints that turn far in a step: steps are cut by how far bodies are read to turn."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.inference.blocks.block import make_block
from boomdp_jax.inference.infer import infer
from boomdp_jax.inference.posteriors.posterior import load_posterior
from boomdp_jax.physics import scene_spec_from_dict, state_from_array, step
from boomdp_jax.physics.scene_spec import SceneSpec

DT = 0.05
HALF, MASS = ((0.15, 0.1), (0.1, 0.06)), (1.2, 0.7)
ANCHORS = {"anchor_a": [0.2, 0.05], "anchor_b": [-0.09, 0.0]}
DOCUMENT = """<mujoco><option gravity="0 0 0" timestep="0.0005" integrator="RK4"/>
<worldbody><body><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
<joint type="hinge" axis="0 0 1"/>
<geom type="box" size="0.15 0.1 0.05" mass="1.2" contype="0" conaffinity="0"/>
<body pos="0.2 0.05 0"><joint type="hinge" axis="0 0 1" damping="0.002"/>
<geom type="box" size="0.1 0.06 0.05" pos="0.09 0 0" mass="0.7" contype="0"
conaffinity="0"/></body></body></worldbody></mujoco>"""


def pair(*, is_known: bool = True) -> SceneSpec:
    """Two boxes on a pin, or of which nothing is known."""
    density = [m / (4.0 * x * y) for m, (x, y) in zip(MASS, HALF, strict=True)]
    bodies = [
        {
            "name": name,
            "shape": {"type": "box", "half_extents": list(half)},
            **({"pose": [0, 0, 0], "density": known} if is_known else {}),
        }
        for name, half, known in zip("ab", HALF, density, strict=True)
    ]
    pin = {"type": "revolute", "a": "a", "b": "b", "viscous": 0.002, **ANCHORS}
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": DT,
            "normal_gravity": 0.0,
            "bodies": bodies,
            **({"constraints": [pin]} if is_known else {"unknown": {"revolute": 1}}),
        },
        source="test",
    )


def turning(rate: float, num_bodies: int, *, unread: tuple[int, ...] = ()):
    """Angles that grow by so many rad/s, everything else at rest."""
    rng = np.random.default_rng(1)
    state = 1e-3 * rng.normal(size=(41, num_bodies, 6))
    state[:, 0, 2] += rate * DT * np.arange(41)
    state[:, 0, 5] += rate
    state[..., list(unread)] = np.nan
    return make_history(state[:-1], np.ones((40, num_bodies, 3)), state[1:], DT)


def num_parts(spec: SceneSpec, history, *, cuts_turns: bool = True) -> int:
    bodies = tuple(range(spec.num_bodies))
    block = make_block(spec, bodies, history, cuts_turns=cuts_turns)
    return block.target.log_likelihood.coordinates.scene.num_substeps


def test_steps_of_pairs_are_cut_by_how_far_they_turn():
    spec = pair(is_known=False)
    for rate, expected in ((1.0, 1), (3.5, 1), (4.5, 2), (9.0, 4), (50.0, 8)):
        assert num_parts(spec, turning(rate, 2)) == expected
    # By the spin where angles were not read; half a turn more is the same angle.
    assert num_parts(spec, turning(9.0, 2, unread=(2,))) == 4
    assert num_parts(spec, turning(9.0, 2, unread=(2, 5))) == 1
    # Shapes of an online table must not depend on what is read.
    assert num_parts(spec, turning(9.0, 2), cuts_turns=False) == 1


def lone(**known) -> SceneSpec:
    """One box."""
    shape = {"type": "box", "half_extents": [0.4, 0.25]}
    body = {"name": "a", "shape": shape, **known.pop("body", {})}
    scene = {"schema": "planar-scene-1", "dt": DT, "bodies": [body], **known}
    return scene_spec_from_dict(scene, source="test")


def test_steps_of_a_lone_body_are_cut_from_two_parts_on():
    spec = lone(unknown={"revolute": 1})
    for rate, expected in ((1.0, 2), (5.5, 2), (6.5, 4), (14.0, 8), (50.0, 8)):
        assert num_parts(spec, turning(rate, 1)) == expected
    assert num_parts(spec, turning(14.0, 1), cuts_turns=False) == 2


@pytest.mark.parametrize("substeps", [1, 3])
def test_steps_are_made_in_the_parts_that_a_scene_gives(substeps: int):
    for spec in (lone(unknown={"revolute": 1}), pair(is_known=False)):
        spec = dataclasses.replace(spec, substeps=substeps)
        for rate in (1.0, 14.0):
            history = turning(rate, spec.num_bodies)
            assert num_parts(spec, history) == substeps
            assert num_parts(spec, history, cuts_turns=False) == substeps


def test_what_a_push_does_to_a_fast_pin_is_as_by_a_fine_rule():
    """Its spin, within a ten-thousandth of what the push could change it by.

    The pin takes up all but the torque about it, (centre - pin) x F + tau, whose first
    part turns with the box: by Simpson's rule, along the turn of a spin without a push.
    So it is with the two parts of a scene that says nothing, and with as many as fast
    turns ask for.
    """
    anchor, mass, rate = np.array([0.3, 0.1]), 10.0, 15.0
    joint = {"anchor_a": anchor.tolist(), "anchor_b": [0.0, 0.0]}
    pin = {"type": "revolute", "a": "a", "b": "world", **joint}
    spec = lone(
        body={"density": mass / (0.8 * 0.5), "pose": [*(-anchor), 0]}, constraints=[pin]
    )
    inertia = mass * ((0.8**2 + 0.5**2) / 12.0 + anchor @ anchor)
    parts = num_parts(lone(unknown={"revolute": 1}), turning(rate, 1))
    scene = dataclasses.replace(spec.scene, num_substeps=parts)
    assert parts > spec.scene.num_substeps == 2
    for push in ([4.0, 0.0, 0.0], [0.0, 4.0, 0.3]):

        def torque(angle, push=push):
            cos, sin = np.cos(angle), np.sin(angle)
            x, y = -(np.array([[cos, -sin], [sin, cos]]) @ anchor)
            return x * push[1] - y * push[0] + push[2]

        angles = rate * DT * np.array([0.0, 0.5, 1.0])
        mean = np.dot([1, 4, 1], [torque(angle) for angle in angles]) / 6.0
        x, y = -anchor
        start = np.array([[x, y, 0.0, -rate * y, rate * x, rate]])
        begin = state_from_array(jnp.asarray(start))
        size = np.hypot(*anchor) * 4.0 * DT / inertia
        for any_scene in (scene, spec.scene):
            found, _ = step(any_scene, spec.params(), begin, jnp.asarray([push]), dt=DT)
            change = float(found.twist[0, 2]) - rate
            assert abs(change - mean * DT / inertia) < 1e-4 * size


@pytest.mark.slow
@pytest.mark.parametrize(
    "rate", [9.0, *(pytest.param(r, marks=pytest.mark.slow) for r in (4.5, 12.0))]
)
def test_a_step_so_cut_goes_where_mujoco_goes(rate: float):
    """Within 0.6 mrad; in one part it is up to 11 mrad off."""
    model = mujoco.MjModel.from_xml_string(DOCUMENT)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = [0, 0, 0, 0.3], [0, 0, 0, rate]
    wrench = np.array([[0.8, -0.5, 0.05], [0.3, 0.4, -0.01]])

    def state() -> np.ndarray:
        mujoco.mj_forward(model, data)
        turn = np.array([data.qpos[2], data.qpos[2] + data.qpos[3]])
        spin = np.array([data.qvel[2], data.qvel[2] + data.qvel[3]])
        speed = np.zeros((2, 6))
        for body in (0, 1):
            kind = mujoco.mjtObj.mjOBJ_BODY
            mujoco.mj_objectVelocity(model, data, kind, body + 1, speed[body], 0)
        return np.column_stack([data.xipos[1:, :2], turn, speed[:, 3:5], spin])

    before = state()
    data.xfrc_applied[1:, :2], data.xfrc_applied[1:, 5] = wrench[:, :2], wrench[:, 2]
    for _ in range(100):
        mujoco.mj_step(model, data)
    after = state()
    spec = pair()
    cut = num_parts(pair(is_known=False), turning(rate, 2))
    error = {}
    for parts in (1, cut):
        scene = dataclasses.replace(spec.scene, num_substeps=parts)
        begin = state_from_array(jnp.asarray(before))
        found, _ = step(scene, spec.params(), begin, jnp.asarray(wrench), dt=DT)
        error[parts] = np.abs(np.asarray(found.pose) - after[:, :3]).max(axis=0)
    assert error[cut][2] < 6e-4
    assert error[cut][:2].max() < 1e-4
    assert error[1][2] > 2.0 * error[cut][2]


@pytest.mark.slow
def test_a_posterior_predicts_with_the_parts_that_it_was_inferred_with(tmp_path):
    known = {"anchor_a": [0.3, 0.1], "anchor_b": [0.0, 0.0]}
    pin = {"type": "revolute", "a": "a", "b": "world", **known}
    body = {"density": 20.0, "pose": [-0.3, -0.1, 0.0]}
    spec = lone(body=body, constraints=[pin])
    rng = np.random.default_rng(0)
    spin, reading = 14.0, np.array([1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 5e-3])
    state = np.array([[-0.3, -0.1, 0.0, 0.1 * spin, -0.3 * spin, spin]])
    fine = jax.jit(
        lambda state, push: (
            step(
                dataclasses.replace(spec.scene, num_substeps=64),
                spec.params(),
                state_from_array(state),
                push,
            )[0].array
        )
    )
    push = rng.uniform(-1.0, 1.0, (30, 1, 3)) * [20.0, 20.0, 3.0]
    states = [state]
    for one in push:
        states.append(np.asarray(fine(jnp.asarray(states[-1]), jnp.asarray(one))))
    states = np.array(states) + reading * rng.standard_normal((31, 1, 6))
    history = make_history(states[:-1], push, states[1:], DT)
    open_spec = lone(unknown={"revolute": 1})
    found = infer(jax.random.key(0), open_spec, history, method="laplace")
    assert open_spec.substeps is None
    assert found.spec.substeps == found.spec.scene.num_substeps == 8
    assert any("steps are made in 8 parts" in n for n in found.diagnostics["notes"])
    found.save(tmp_path / "found.npz")
    assert load_posterior(tmp_path / "found.npz").spec.substeps == 8
    # What a scene says is what is taken, and there is nothing to say.
    told = dataclasses.replace(open_spec, substeps=2)
    found = infer(jax.random.key(0), told, history, method="laplace")
    assert found.spec.substeps == 2
    assert not any("parts" in note for note in found.diagnostics["notes"])
