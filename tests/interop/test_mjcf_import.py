"""Documents read as scenes: our own come back, and others' mean what MuJoCo does."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest

from boomdp_jax.interop import from_mjcf, to_mjcf
from tests.interop.mjcf_documents import BOX, BRAKE, FREE, QUIET, document
from tests.interop.mjcf_worlds import (
    ball,
    box,
    distance,
    joint,
    run_mujoco,
    run_ours,
    scene,
)

EXACT = 1e-9
TOUCH = {"friction": 0.4, "restitution": 0.3}


def machine():
    """A bit of everything, nothing of which is at the origin."""
    wedge = {"type": "polygon", "vertices": [[-0.2, -0.1], [0.3, -0.1], [-0.2, 0.25]]}
    shelf = rotated(0.2, (0.4, 0.1)) + np.array([0.0, 0.5])
    drawer = shelf + 0.15 * direction(0.5) - rotated(0.7, (0.05, -0.02))
    bodies = [
        box("base", (0.0, 0.5, 0.2), static=True),
        box("drawer", (*drawer, 0.7), density=12.5, center_of_mass=[0.05, 0.02]),
        box("door", (1.3, 0.0, 7.0), twist=[0, 0, 0.4], density=7.0),
        ball("knob", (2.0, 0.5, 0.3), radius=0.07, density=31.0),
        {"name": "wedge", "shape": wedge, "pose": [3.0, 1, -0.4], "density": 9.0},
        box("cart", (-1.0, -1.0, 0.9), twist=[0.1, -0.2, 0.3], half=(0.4, 0.2)),
    ]
    constraints = [
        joint(
            "prismatic",
            "drawer",
            "base",
            (0.1, 0.0),
            (0.4, 0.1),
            axis=0.3,
            angle=0.5,
            dry=0.7,
            viscous=2.0,
            upper=0.4,
            motor_speed=0.2,
            motor_force=3.0,
        ),
        joint(
            "revolute",
            "door",
            "world",
            (-0.3, 0.02),
            (1.0, 0.0),
            viscous=0.13,
            lower=-1.0,
            upper=9.0,
        ),
        joint(
            "revolute",
            "door",
            "knob",
            (0.25, 0.01),
            (-0.05, 0.03),
            dry=0.02,
            lower=-2.0,
            upper=8.0,
            motor_speed=-0.4,
            motor_torque=0.3,
        ),
        joint("weld", "wedge", "knob", (-0.4, 0.1), (0.2, 0.0), angle=-0.8),
        joint("distance", "cart", "world", (0.3, 0.1), (-2.0, -1.0), length=1.2),
        {
            "type": "wheel",
            "a": "cart",
            "pose": [0.2, -0.1, 2.5],
            "viscous": [0.3, 40.0],
            "dry": [5.0, 6.0],
        },
        {"type": "ground", "a": "cart", "dry": 0.25, "viscous": 30.0},
    ]
    return scene(bodies, *constraints, gravity=(0.3, -2.0), normal_gravity=9.0)


def rotated(angle, vector):
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin], [sin, cos]]) @ vector


def direction(angle):
    return np.array([math.cos(angle), math.sin(angle)])


def by_ends(spec):
    """Constraints by kind and names."""
    names = (*spec.names, "world")
    return {(c.kind, names[c.body_a], names[c.body_b]): c for c in spec.constraints}


def assert_same_feet(body, same):
    """Points are where they were; feet with a size come back as points of theirs."""
    if not np.any(body.foot_size) or np.any(same.foot_size):
        np.testing.assert_allclose(body.feet, same.feet, atol=1e-7)
        np.testing.assert_allclose(body.foot_size, same.foot_size, atol=1e-7)
        return
    arms = np.hypot(np.hypot(*body.feet.T), body.foot_size)
    assert np.mean(same.feet**2) == pytest.approx(np.mean(arms**2) / 2, rel=1e-6)


def assert_same(one, other):
    """Two scenes of the same bodies and constraints, in any order."""
    assert set(one.names) == set(other.names)
    np.testing.assert_allclose(one.gravity, other.gravity, atol=EXACT)
    assert one.normal_gravity == pytest.approx(other.normal_gravity, abs=EXACT)
    assert one.dt == pytest.approx(other.dt, abs=EXACT)
    for body in one.bodies:
        same = other.bodies[other.index(body.name)]
        assert (body.kind, body.is_static) == (same.kind, same.is_static)
        if not body.is_static:
            mass, again = body.density * body.area, same.density * same.area
            assert mass == pytest.approx(again, rel=EXACT)
            rel = EXACT if body.kind != "polygon" else 1e-6
            assert body.gyration == pytest.approx(same.gyration, rel=rel)
        assert_same_feet(body, same)
        assert body.has_contact == same.has_contact
        if body.has_contact:
            assert body.friction == pytest.approx(same.friction, abs=EXACT)
            assert body.restitution == pytest.approx(same.restitution, abs=EXACT)
    assert by_ends(one).keys() == by_ends(other).keys()
    for ends, constraint in by_ends(one).items():
        same = by_ends(other)[ends].numbers
        numbers = constraint.numbers
        assert numbers.keys() == same.keys(), ends
        if constraint.kind == "weld":
            places = [
                n["anchor_b"] - rotated(n["angle"], n["anchor_a"])
                for n in (numbers, same)
            ]
            np.testing.assert_allclose(*places, atol=EXACT)
            assert numbers["angle"] == pytest.approx(float(same["angle"]), abs=EXACT)
            continue
        for key, number in numbers.items():
            np.testing.assert_allclose(
                number, same[key], rtol=EXACT, atol=EXACT, err_msg=f"{ends} {key}"
            )


def test_machine_comes_back():
    spec = machine()
    again = from_mjcf(to_mjcf(spec, spec.params()))
    assert_same(spec, again)
    # Where nothing pulls bodies together they are also where they were.
    index = [again.index(name) for name in ("base", "drawer", "cart")]
    ours = [spec.index(name) for name in ("base", "drawer", "cart")]
    np.testing.assert_allclose(again.pose[index], spec.pose[ours], atol=EXACT)
    cart = again.bodies[again.index("cart")]
    np.testing.assert_allclose(cart.twist, [0.1, -0.2, 0.3], atol=EXACT)
    assert again.pose[again.index("door"), 2] == pytest.approx(7.0, abs=EXACT)


def test_draw_comes_back_with_its_own_numbers():
    spec = machine()
    params = spec.params()
    params = dataclasses.replace(
        params,
        density=1.7 * params.density,
        revolute=dataclasses.replace(
            params.revolute, anchor_a=params.revolute.anchor_a + 0.03
        ),
    )
    again = from_mjcf(to_mjcf(spec, params))
    knob = again.bodies[again.index("knob")]
    assert knob.density == pytest.approx(1.7 * 31.0, rel=EXACT)
    pin = by_ends(again)["revolute", "door", "world"].numbers
    np.testing.assert_allclose(pin["anchor_a"], [-0.27, 0.05], atol=EXACT)


def test_loop_comes_back():
    bars = [box(name, (0.1 * i, 0, 0)) for i, name in enumerate("abc")]
    pins = [
        joint("revolute", "a", "world", (-0.3, 0), (0, 0)),
        joint("revolute", "a", "b", (0.3, 0), (-0.3, 0)),
        joint("revolute", "b", "c", (0.3, 0), (0.3, 0)),
        joint("revolute", "c", "world", (-0.3, 0), (0.6, 0.2)),
        joint("weld", "c", "a", (0.1, 0.0), (0.2, 0.3), angle=0.6),
    ]
    spec = scene(bars, *pins)
    assert_same(spec, from_mjcf(to_mjcf(spec, spec.params())))


def test_contact_and_its_groups_come_back():
    bodies = [
        box("floor", (0, -0.1, 0), half=(2, 0.1), static=True, contact=TOUCH),
        ball("one", (0, 0.5, 0), contact=TOUCH | {"group": "crew"}),
        ball("two", (1, 0.5, 0), contact=TOUCH | {"group": "crew"}),
        box("three", (-1, 0.5, 0), contact=TOUCH),
    ]
    spec = scene(bodies)
    again = from_mjcf(to_mjcf(spec, spec.params(), time_step=0.001))
    assert_same(spec, again)
    order = [again.index(name) for name in spec.names]
    ours = np.asarray(again.scene.collides)[np.ix_(order, order)]
    np.testing.assert_array_equal(ours, np.asarray(spec.scene.collides))


FOREIGN = """
<mujoco>
  <compiler angle="degree"/>
  <default><joint damping="0.05"/><geom density="300" type="box"/></default>
  <option timestep="0.004" gravity="0 -9.81 0"/>
  <asset><mesh name="hex" scale="0.5 0.5 0.5" vertex="
    1 0 0  .5 .8660254 0  -.5 .8660254 0  -1 0 0  -.5 -.8660254 0  .5 -.8660254 0
    1 0 .2 .5 .8660254 .2 -.5 .8660254 .2 -1 0 .2 -.5 -.8660254 .2 .5 -.8660254 .2"/>
  </asset>
  <worldbody>
    <light pos="0 0 3"/>
    <body name="mount" pos="1 1 0.3" euler="0 0 20">
      <body name="rod" pos="0.1 0 0" euler="0 0 -50">
        <joint name="swing" axis="0 0 -1" pos="-0.4 0 0"
          range="-90 170" limited="true"/>
        <geom size="0.4 0.05 0.02" pos="0.02 0.01 0" euler="0 0 30"/>
        <body name="rider" pos="0.2 0.3 0">
          <joint name="rail" type="slide" axis="1 1 0" range="-0.2 0.3" limited="true"/>
          <geom type="cylinder" size="0.1 0.3"/>
          <body name="flag" pos="0 0.4 0"><geom type="mesh" mesh="hex"/></body>
        </body>
      </body>
    </body>
    <body name="puck" pos="-2 0 0" euler="0 0 40">
      <joint type="slide" axis="0 1 0" damping="0"/>
      <joint type="hinge" axis="0 0 1" damping="0"/>
      <joint type="slide" axis="1 0 0" damping="0"/>
      <geom size="0.2 0.1 0.1"/>
      <site name="tip" pos="0.3 0 0"/>
    </body>
  </worldbody>
  <actuator><motor joint="swing"/></actuator>
  <sensor><gyro site="tip"/></sensor>
</mujoco>
"""


def without_contact(text):
    return text.replace('type="box"/>', 'type="box" contype="0" conaffinity="0"/>')


@pytest.mark.slow
def test_foreign_document_moves_as_in_mujoco():
    stiff = 'solimp="0.9999 0.9999 0.001"'
    tie = f'<connect site1="tip" site2="nail" solref="0.001 1" {stiff}/>'
    text = without_contact(FOREIGN)
    text = text.replace("<light", '<site name="nail" pos="-1.9 0.5 0"/><light')
    text = text.replace("<actuator>", f"<equality>{tie}</equality><actuator>")
    # The key frame is what `run_mujoco` starts from; the equality starts satisfied.
    start = rotated(math.radians(40), (0.3, 0.0))
    text = text.replace('pos="-2 0 0"', f'pos="{-1.9 - start[0]} {0.5 - start[1]} 0"')
    text = text.replace("</mujoco>", "<keyframe><key/></keyframe></mujoco>")
    spec = dataclasses.replace(from_mjcf(text), dt=0.02)
    assert spec.names == ("rod", "rider", "flag", "puck")
    fine = text.replace(
        'timestep="0.004"', 'timestep="0.0005" integrator="implicitfast"'
    )
    path = run_mujoco(fine, spec, 20)
    ours = run_ours(spec, spec.params(), 20, dt=0.001)
    model = mujoco.MjModel.from_xml_string(text)
    # MuJoCo's frames are at the bodies' own origins, ours at centres of mass.
    for i, name in enumerate(spec.names):
        offset = model.body(name).ipos[:2]
        for row in range(len(path)):
            path[row, i, :2] += rotated(path[row, i, 2], offset)
    assert distance(ours, path) < 3e-3


def test_foreign_masses_and_ranges_are_read():
    spec = from_mjcf(without_contact(FOREIGN))
    model = mujoco.MjModel.from_xml_string(FOREIGN)
    for body in spec.bodies:
        mass = body.density * body.area
        assert mass == pytest.approx(model.body(body.name).mass[0], rel=EXACT)
    assert [c.kind for c in spec.constraints] == ["revolute", "prismatic", "weld"]
    swing, rail, _ = spec.constraints
    # theta = -q from -30 degrees (20 - 50), so that [-90, 170] becomes [-200, 60].
    np.testing.assert_allclose(np.rad2deg(swing.numbers["limit"]), [-200, 60])
    np.testing.assert_allclose(rail.numbers["limit"], [-0.2, 0.3])
    # The parent's frame is that of MuJoCo's body.
    assert float(rail.numbers["axis"]) == pytest.approx(math.pi / 4)
    assert float(swing.numbers["viscous"]) == 0.05
    assert spec.dt == 0.004
    assert spec.normal_gravity == 0.0


def test_upright_plane_is_a_static_box():
    floor = '<geom name="floor" type="plane" size="0 0 1" zaxis="0 1 0"/>'
    spec = from_mjcf(document(world=floor, geom=BOX))
    assert spec.names == ("floor", "thing")
    path = run_ours(spec, spec.params(), 400, dt=None)
    np.testing.assert_allclose(path[-1, 1], [0, 0.1, 0], atol=2e-3)


def test_body_equalities_hold_where_mujoco_has_them_hold():
    other = f'<body name="other" pos="1 0.5 0">{FREE}<geom {QUIET}/></body>'
    ties = """<equality><connect body1="thing" body2="other" anchor="0.3 0.1 0"/>
      <weld body1="other" body2="thing" relpose="0.5 0.2 0 0.8 0 0 0.6"
        anchor="0.1 0 0"/></equality>"""
    text = document(others=other, sections=ties)
    pin, weld = from_mjcf(text).constraints
    np.testing.assert_allclose(pin.numbers["anchor_a"], [0.3, 0.1], atol=EXACT)
    np.testing.assert_allclose(pin.numbers["anchor_b"], [-0.7, 0.2], atol=EXACT)
    # Put `thing`, b of the weld, where our numbers say, beside `other`, a.
    numbers = weld.numbers
    turn = 0.3 - float(numbers["angle"])
    place = rotated(0.3, numbers["anchor_a"]) - rotated(turn, numbers["anchor_b"])
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    x, y = place
    data.qpos[:] = [x + 0.4, y + 0.5 - 0.6, turn, -0.6, 0.0, 0.3]
    mujoco.mj_forward(model, data)
    # Three rows of the pin, then six of the weld.
    np.testing.assert_allclose(data.efc_pos[3:9], 0, atol=1e-9)
    assert np.max(np.abs(data.efc_pos[:3])) > 0.1


def test_one_sided_brake_is_a_wheel_without_the_other():
    site = '<site name="s" pos="0.1 0 0"/>'
    for gear, heading, viscous in (
        ("2 0 0 0 0 0", 0.0, [12.0, 0.0]),
        ("0 2 0 0 0 0", 0.0, [0.0, 12.0]),
    ):
        brake = BRAKE.format(bias="0 0 -3", place=f'site="s" gear="{gear}"')
        text = document(more=site, sections=f"<actuator>{brake}</actuator>")
        (wheel,) = from_mjcf(text).constraints
        np.testing.assert_allclose(wheel.numbers["viscous"], viscous)
        np.testing.assert_allclose(wheel.numbers["position"], [0.1, 0])
        assert float(wheel.numbers["heading"]) == heading
        assert np.all(np.isinf(wheel.numbers["dry"]))


def test_file_is_read_by_its_path(tmp_path):
    path = tmp_path / "world.xml"
    path.write_text(document(), encoding="utf-8")
    assert from_mjcf(path).names == ("thing",)
    assert from_mjcf(path).source == str(path)


def test_sphere_is_a_disc_where_its_inertia_may_differ():
    text = document(geom='type="sphere" size="0.1" contype="0" conaffinity="0"')
    (body,) = from_mjcf(text, inertia_tolerance=0.2).bodies
    assert body.radius == 0.1
    mass = 1000 * 4 / 3 * math.pi * 0.1**3
    assert body.density * body.area == pytest.approx(mass)
