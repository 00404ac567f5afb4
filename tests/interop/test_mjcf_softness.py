"""How hard a constraint is said to be, against what MuJoCo makes of its numbers."""

import mujoco
import numpy as np
import pytest

from boomdp_jax.interop import from_mjcf, to_mjcf
from boomdp_jax.interop.mjcf_softness import impedance
from tests.interop.mjcf_documents import document
from tests.interop.mjcf_worlds import box, joint, scene

HINGE = '<joint name="j" type="hinge" axis="0 0 1" range="-1 0.5" {}/>'


def test_the_share_of_a_spring_that_acts_is_that_of_mujoco():
    model = mujoco.MjModel.from_xml_string(document(joints=HINGE.format("")))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(64):
        least, most, middle = rng.uniform(0.0, 1.0, 3)
        solimp = [least, most, rng.uniform(0.0, 0.2), middle, rng.uniform(1.0, 4.0)]
        depth = rng.uniform(1e-4, 0.1)
        model.jnt_solimp[0], data.qpos[0] = solimp, 0.5 + depth
        mujoco.mj_forward(model, data)
        theirs = data.efc_KBIP[0, 2]
        assert impedance(np.array(solimp), depth) == pytest.approx(theirs, rel=1e-9)


@pytest.mark.parametrize(
    "fields",
    [
        "",
        'solreflimit="0.1 1"',
        'solreflimit="0.01 2"',
        'solreflimit="-10000 -200"',
        'solimplimit="0 0.95 0.005"',
        # What is not there is not soft.
        'solreflimit="1 1" limited="false"',
        'solreffriction="1 1"',
        # MuJoCo takes numbers of two signs for none.
        'solreflimit="-1 1"',
    ],
)
def test_what_is_about_as_hard_as_usual_is_read(fields, tmp_path, monkeypatch):
    # MuJoCo writes its warnings where it is.
    monkeypatch.chdir(tmp_path)
    assert len(from_mjcf(document(joints=HINGE.format(fields))).constraints) == 1


def test_our_own_ends_and_loops_are_hard_at_any_time_step():
    bodies = [box("upper", (0.3, 0, 0)), box("lower", (0.9, 0, 0))]
    spec = scene(
        bodies,
        joint("revolute", "upper", "world", (-0.3, 0), (0, 0), lower=-1.0, dry=0.1),
        joint("revolute", "upper", "lower", (0.3, 0), (-0.3, 0)),
        joint("distance", "lower", "world", (0.3, 0), (1.2, 0.5), length=0.5),
    )
    for time_step in (0.001, 0.02):
        again = from_mjcf(to_mjcf(spec, spec.params(), time_step=time_step))
        assert len(again.constraints) == 3


@pytest.mark.parametrize(("constant", "most"), [(0.04, 5e-3), (0.1, 5e-2)])
def test_a_stop_that_is_accepted_holds_in_mujoco_about_as_here(constant, most):
    """It goes beyond its end by what the spring has to bear, the more the softer."""
    stop = f'pos="-0.2 0 0" solreflimit="{constant} 1"'
    text = document(joints=HINGE.format(stop))
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 3000)
    (pin,) = from_mjcf(text).constraints
    assert data.qpos[0] == pytest.approx(pin.numbers["limit"][0], abs=most)


def test_our_own_contact_is_hard_at_any_time_step():
    touch = {"contact": {"friction": 0.4, "restitution": 0.0}}
    floor = box("floor", (0, -0.1, 0), half=(2, 0.1), static=True, **touch)
    spec = scene([floor, box("box", (0, 0.3, 0), **touch)])
    for time_step in (0.001, 0.02):
        again = from_mjcf(to_mjcf(spec, spec.params(), time_step=time_step))
        assert all(body.has_contact for body in again.bodies)
