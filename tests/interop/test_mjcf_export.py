"""Exported documents say what the hypothesis says, and move in MuJoCo as it does here.

Paths are compared at two pairs of time steps: the error of "implicitfast", of first
order, leads, so that the difference must halve with them.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from boomdp_jax.interop import save_mjcf, to_mjcf
from boomdp_jax.interop.mjcf_export import _check_types, _read_options
from boomdp_jax.physics.params import Actuator
from tests.interop.mjcf_worlds import (
    ball,
    box,
    distance,
    joint,
    run_mujoco,
    run_ours,
    scene,
)

NUM_STEPS = 25
GROUND = {"type": "ground", "a": "box"}
PIN = joint("revolute", "box", "world", (-0.3, 0.0), (0.0, 0.0))
ELBOW = joint("revolute", "upper", "lower", (0.3, 0.0), (-0.3, 0.0), viscous=0.02)


def thing(twist=(0.0, 0.0, 0.0), **fields):
    return box("box", (0.3, 0.0, 0.0), twist=list(twist), **fields)


def arm():
    return [box("upper", (0.3, 0, 0)), box("lower", (0.9, 0, 0))]


def four_bar():
    """A closed chain that can move, with the hanging bars as pendulums."""
    bars = [
        box("left", (0.0, -0.3, -math.pi / 2)),
        box("bottom", (0.3, -0.6, 0.0)),
        box("right", (0.6, -0.3, -math.pi / 2)),
    ]
    pins = [
        joint("revolute", "left", "world", (-0.3, 0), (0, 0)),
        joint("revolute", "left", "bottom", (0.3, 0), (-0.3, 0)),
        joint("revolute", "bottom", "right", (0.3, 0), (0.3, 0)),
        joint("revolute", "right", "world", (-0.3, 0), (0.6, 0)),
    ]
    return scene(bars, *pins), [[1.0, 0, 0.5], [3.0, 0, 0], [0, 0, 0]]


def wheeled(**friction):
    wheel = {"type": "wheel", "a": "box", "pose": [-0.2, 0.0, 0.6], **friction}
    return scene([thing((1.0, -0.5, 0.5))], wheel, gravity=(0, 0)), [[1, 2, 0]]


def rail(**fields):
    drawer = joint(
        "prismatic", "box", "base", (0.1, 0), (0.4, 0.1), axis=-0.7, angle=0.5, **fields
    )
    base = box("base", (0.0, 0.5, 0.2), static=True)
    dx, dy = rotate(0.2, (0.4, 0.1)) - rotate(0.7, (0.1, 0.0))
    start = {"type": "box", "half_extents": [0.3, 0.1]}
    body = {"name": "box", "shape": start, "pose": [dx, 0.5 + dy, 0.7], "density": 20}
    return scene([body, base], drawer), None


def rotate(angle, vector):
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]]) @ vector


WORLDS = {
    "free body": (scene([thing((0.5, 0.2, 2.0))]), [[1, 2, 0.3]]),
    "damped pendulum": (scene([thing()], PIN | {"viscous": 0.1}), None),
    "pendulum that sticks": (scene([thing()], PIN | {"dry": 1.5}), None),
    "pendulum with both": (scene([thing()], PIN | {"dry": 0.5, "viscous": 0.4}), None),
    "stop": (scene([thing()], PIN | {"lower": -0.7, "viscous": 0.3}), None),
    "motor": (
        scene([thing()], PIN | {"motor_speed": 2.0, "motor_torque": 20.0}),
        None,
    ),
    "double pendulum": (scene(arm(), PIN | {"a": "upper"}, ELBOW), None),
    "drawer": (rail(viscous=0.3)[0], None),
    "weld": (
        scene(
            arm(),
            PIN | {"a": "upper"},
            joint("weld", "upper", "lower", (0.3, 0.0), (-0.3, 0.0)),
        ),
        None,
    ),
    "wheel": wheeled(viscous=[0.8, 15.0]),
    "rod": (
        scene(
            [thing()],
            joint("distance", "box", "world", (-0.3, 0), (0, 0.4), length=0.4),
        ),
        None,
    ),
    "four-bar loop": four_bar(),
}


def gap(spec, wrench, time_step, num_steps=NUM_STEPS, integrator=None):
    params = spec.params()
    text = to_mjcf(spec, params, time_step=time_step, integrator=integrator)
    theirs = run_mujoco(text, spec, num_steps, wrench)
    ours = run_ours(spec, params, num_steps, wrench, dt=5 * time_step)
    return distance(ours, theirs)


@pytest.mark.slow
@pytest.mark.parametrize("name", WORLDS)
def test_difference_halves_with_time_steps(name):
    spec, wrench = WORLDS[name]
    coarse, fine = (
        gap(spec, wrench, step, integrator="implicitfast") for step in (0.001, 0.0005)
    )
    assert coarse < 6e-3
    assert fine < 0.62 * coarse + 1e-7


@pytest.mark.parametrize("name", ["free body", "double pendulum", "wheel"])
def test_moves_as_in_mujoco(name):
    spec, wrench = WORLDS[name]
    assert gap(spec, wrench, 0.0005) < 3e-3


def test_floor_brakes_within_the_stated_share():
    # It slides v²/2µg, where a foot's limit is within 6 %.
    for angle in (0.0, math.pi / 8, 0.7):
        body = thing((math.cos(angle), math.sin(angle), 0.0))
        spec = scene([body], GROUND | {"dry": 0.2}, gravity=(0, 0))
        path = run_mujoco(to_mjcf(spec, spec.params(), time_step=0.001), spec, 40)
        slid = math.hypot(*(path[-1, 0, :2] - spec.pose[0, :2]))
        # Below the knee the last of it is viscous.
        assert slid == pytest.approx(1.0 / (2 * 0.2 * 9.81), rel=0.065)
        moved = path[-1, 0, :2] - spec.pose[0, :2]
        bent = math.degrees(math.atan2(moved[1], moved[0]) - angle)
        assert abs(bent) < 22.5


@pytest.mark.slow
def test_floor_turns_a_body_as_the_engine_does():
    spec = scene(
        [thing((1.0, -0.5, 1.5), center_of_mass=[0.1, 0.05])],
        GROUND | {"dry": 0.2},
        gravity=(0, 0),
    )
    assert gap(spec, None, 0.001) < 0.04


def test_slipping_wheel_is_near_though_its_limits_are_a_box():
    # The ellipse also takes most of the rolling friction, 0.8 N, off a slipping wheel:
    # half a second of it moves 2.4 kg by 4 cm.
    spec, wrench = wheeled(viscous=[0.8, 50.0], dry=[100.0, 3.0])
    assert gap(spec, wrench, 0.001) < 0.042


def test_sliding_wheel_feels_its_limit():
    # Pushed across by 5 N against 3 N, m a = 2 N.
    wheel = {"type": "wheel", "a": "box", "pose": [0, 0, 0], "viscous": [0, 1e5]}
    spec = scene([thing()], wheel | {"dry": [1, 3]}, gravity=(0, 0))
    text = to_mjcf(spec, spec.params(), time_step=0.0005)
    path = run_mujoco(text, spec, 25, [[0, 5.0, 0]])
    mass = 20.0 * 4 * 0.3 * 0.1
    assert path[-1, 0, 1] == pytest.approx(0.5 * 2.0 / mass * 0.5**2, rel=5e-3)


FLOOR = {"half": (2.0, 0.1), "static": True}


@pytest.mark.slow
def test_box_slides_to_a_stop_on_a_static_one():
    touch = {"contact": {"friction": 0.3}}
    body = box("box", (-0.3, 0.1, 0), twist=[1.5, 0, 0], **touch)
    spec = scene([body, box("floor", (0, -0.1, 0), **FLOOR, **touch)])
    path = run_mujoco(to_mjcf(spec, spec.params(), time_step=0.0005), spec, 40)
    assert path[-1, 0, 0] + 0.3 == pytest.approx(1.5**2 / (2 * 0.3 * 9.81), rel=5e-3)
    assert distance(run_ours(spec, spec.params(), 40, dt=0.0025), path) < 2e-3


def test_ball_bounces_to_the_square_of_restitution():
    touch = {"contact": {"friction": 0.0, "restitution": 0.6}}
    ball_above = ball("ball", (0, 0.6, 0), **touch)
    spec = scene([ball_above, box("floor", (0, -0.1, 0), **FLOOR, **touch)])
    path = run_mujoco(to_mjcf(spec, spec.params(), time_step=0.0005), spec, 40)
    hits = int(np.argmin(path[:20, 0, 1]))
    assert path[hits:, 0, 1].max() - 0.1 == pytest.approx(0.36 * 0.5, rel=0.1)


@pytest.mark.slow
def test_polygon_is_pushed_by_a_ball():
    touch = {"contact": {"friction": 0.0}}
    wedge = {"type": "polygon", "vertices": [[-0.2, -0.2], [0.2, -0.2], [-0.2, 0.2]]}
    bodies = [
        ball("ball", (-0.6, 0.0, 0), **touch),
        {"name": "wedge", "shape": wedge, "pose": [0, 0, 0], "density": 20} | touch,
    ]
    spec = scene(bodies, {"type": "ground", "a": "wedge", "viscous": 5}, gravity=(0, 0))
    push = [[2.0, 0, 0], [0, 0, 0]]
    params = spec.params()
    theirs = run_mujoco(to_mjcf(spec, params, time_step=0.001), spec, 40, push)
    assert theirs[-1, 1, 0] > 0.05
    assert distance(run_ours(spec, params, 40, push, dt=0.005), theirs) < 0.02


def test_document_holds_masses_names_and_start():
    params = WORLDS["double pendulum"][0].params()
    spec = WORLDS["double pendulum"][0]
    model = mujoco.MjModel.from_xml_string(to_mjcf(spec, params))
    mass = 20.0 * 4 * 0.3 * 0.1
    inertia = mass * (0.3**2 + 0.1**2) / 3
    for name in ("upper", "lower"):
        np.testing.assert_allclose(model.body(name).mass, mass, rtol=1e-12)
        np.testing.assert_allclose(model.body(name).inertia[2], inertia, rtol=1e-12)
    assert model.joint("lower.pin").bodyid[0] == model.body("lower").id
    assert model.opt.timestep == pytest.approx(0.002)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.body("lower").xipos, [0.9, 0, 0], atol=1e-12)


def test_center_of_mass_of_a_draw_is_where_it_says():
    spec = WORLDS["free body"][0]
    params = dataclasses.replace(
        spec.params(), center_of_mass=jnp.asarray([[0.07, -0.02]])
    )
    model = mujoco.MjModel.from_xml_string(to_mjcf(spec, params))
    np.testing.assert_allclose(model.body("box").ipos, [0.07, -0.02, 0], atol=1e-12)


def test_names_may_hold_any_character():
    spec = scene([box('a <"b"> -- & c', (0, 0, 0))])
    text = to_mjcf(spec, spec.params())
    assert mujoco.MjModel.from_xml_string(text).body('a <"b"> -- & c').id == 1


def test_comment_says_what_is_near():
    spec = scene([thing()], GROUND | {"dry": 0.2}, gravity=(0, 0))
    assert "box.ground: the limit of a foot" in to_mjcf(spec, spec.params())
    spec = WORLDS["double pendulum"][0]
    assert "<!--" not in to_mjcf(spec, spec.params())


def test_missing_start_is_the_origin_and_said():
    body = {k: v for k, v in thing().items() if k != "pose"}
    text = to_mjcf(scene([body]), scene([body]).params())
    assert "box: no start in the scene" in text
    model = mujoco.MjModel.from_xml_string(text)
    np.testing.assert_array_equal(model.key_qpos[0], np.zeros(3))


def test_file_is_the_document(tmp_path):
    spec = WORLDS["wheel"][0]
    save_mjcf(spec, spec.params(), tmp_path / "wheel.xml", integrator="RK4")
    text = (tmp_path / "wheel.xml").read_text(encoding="utf-8")
    assert text == to_mjcf(spec, spec.params(), integrator="RK4")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "wheel.xml"))
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4


@pytest.mark.slow
def test_law_shapes_of_wheel_and_floor_are_carried():
    spec = scene(
        [thing((1.0, -0.5, 1.5))],
        GROUND | {"viscous": 4.0},
        {"type": "wheel", "a": "box", "pose": [0.1, 0, 0.4], "viscous": [0.3, 9.0]},
        gravity=(0, 0),
    )
    params = spec.params()
    params = dataclasses.replace(
        params,
        wheel=dataclasses.replace(params.wheel, half_track=jnp.full((1, 1), 0.15)),
        ground=dataclasses.replace(
            params.ground,
            torque_share=jnp.full((1, 1), 0.4),
            load_shift=jnp.asarray([[[0.05, 0.02]]]),
            stance_scale=jnp.asarray([[[1.3, 0.8]]]),
            corner_share=jnp.full((1, 1), 0.7),
            diagonal_share=jnp.full((1, 1), 0.3),
        ),
        center_of_mass=jnp.asarray([[0.04, 0.03]]),
    )
    theirs = run_mujoco(to_mjcf(spec, params, time_step=0.0005), spec, 25)
    assert distance(run_ours(spec, params, 25, dt=0.0025), theirs) < 1.5e-3


def refused(spec, params, message):
    with pytest.raises(ValueError, match=message):
        to_mjcf(spec, params)


def test_batch_is_refused():
    spec = WORLDS["free body"][0]
    batch = jax.tree.map(lambda leaf: leaf[None], spec.params())
    refused(spec, batch, "expected one hypothesis, got axes")


@pytest.mark.parametrize(
    ("order", "message"),
    [
        ("two.xml spec params", "spec: expected a SceneSpec, got str"),
        ("params spec two.xml", "spec: expected a SceneSpec, got Params"),
        ("spec two.xml params", "params: expected Params, got str"),
        ("spec params spec", "path: expected a path, got SceneSpec"),
    ],
)
def test_swapped_arguments_are_refused(order, message):
    # The public functions begin with this; here their types would be checked before.
    spec = WORLDS["free body"][0]
    given = {"spec": spec, "params": spec.params()}
    with pytest.raises(ValueError, match=message):
        _check_types(*(given.get(name, name) for name in order.split()))


@pytest.mark.parametrize("time_step", [-1.0, 0.0, float("nan"), float("inf")])
def test_a_time_step_that_is_none_is_refused(time_step):
    spec = WORLDS["free body"][0]
    message = f"time_step: expected a finite number above 0, got {time_step}"
    with pytest.raises(ValueError, match=message):
        to_mjcf(spec, spec.params(), time_step=time_step)


def test_options_of_other_types_are_refused():
    # The public functions begin with this; here their types would be checked before.
    with pytest.raises(ValueError, match=r"time_step: expected a finite .* got 'x'"):
        _read_options("x", "Euler")
    with pytest.raises(ValueError, match=r"integrator: expected .* RK4, got 'foo'"):
        _read_options(0.002, "foo")
    # A number of NumPy's would be written with its type's name.
    assert repr(_read_options(np.float64(0.002), "RK4")) == "0.002"


def test_params_of_another_scene_are_refused():
    spec = WORLDS["free body"][0]
    refused(spec, scene(arm()).params(), "expected densities of 1 bodies, got 2")


def test_density_of_nothing_is_refused():
    spec = WORLDS["free body"][0]
    params = dataclasses.replace(spec.params(), density=jnp.asarray([0.0]))
    refused(spec, params, "body 'box': expected a density above 0, got 0")


def test_actuator_is_refused():
    spec = WORLDS["free body"][0]
    params = dataclasses.replace(
        spec.params(), actuator=Actuator(gain=jnp.asarray([0.9]))
    )
    refused(spec, params, "params.actuator: expected none")


def test_two_floors_are_refused():
    ground = GROUND | {"viscous": 1.0}
    spec = scene([thing()], ground, ground, gravity=(0, 0))
    refused(spec, spec.params(), "body 'box': expected one ground friction, got 2")


def test_drawer_that_closes_a_loop_is_refused():
    slide = joint("prismatic", "box", "world", (0, 0), (0.3, 0), axis=0.0)
    spec = scene([thing()], slide, slide | {"axis": 1.0})
    refused(spec, spec.params(), "prismatic of body 'box': expected no loop")


def test_friction_in_a_loop_is_refused():
    spec = scene([thing()], PIN | {"viscous": 1.0}, PIN | {"viscous": 2.0})
    refused(spec, spec.params(), "pin 'box.world.revolute1': expected no friction")
