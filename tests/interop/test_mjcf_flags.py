"""What a document disables is not there, as in MuJoCo; and ends are where they hold."""

import math

import mujoco
import pytest

from boomdp_jax.interop import from_mjcf
from tests.interop.mjcf_documents import BRAKE, FREE, document
from tests.interop.mjcf_worlds import distance, run_mujoco, run_ours

OPTION = '<option gravity="0 -9.81 0"/>'
HINGE = '<joint name="j" type="hinge" axis="0 0 1" pos="-0.2 0 0" {}/>'
DRIVE = BRAKE.format(bias="0 0 -0.5", place='joint="j" group="2"')
NAIL = '<equality><connect body1="thing" anchor="0.2 0 0"/></equality>'
SPATIAL = (
    '<tendon><spatial limited="true" range="0 0.1" {}><site site="u"/><site site="v"/>'
    "</spatial></tendon>"
)
ROPE = {
    "world": '<site name="u"/>',
    "more": '<site name="v" pos="0.2 0 0"/>',
    "sections": SPATIAL.format(""),
}
DAMPED = HINGE.format('damping="0.5"')
WORLDS = {
    'flag damper="disable"': {"joints": DAMPED},
    'flag frictionloss="disable"': {"joints": HINGE.format('frictionloss="3"')},
    'flag limit="disable"': {"joints": HINGE.format('range="-0.2 0.3"')},
    'flag limit="disable" ': ROPE,
    'flag spring="disable"': {"joints": HINGE.format('stiffness="20"')},
    'flag equality="disable"': {"sections": NAIL},
    'flag constraint="disable"': {
        "joints": HINGE.format('frictionloss="3" range="-0.2 0.3"')
    },
    'flag actuation="disable"': {
        "joints": HINGE.format(""),
        "sections": f"<actuator>{DRIVE}</actuator>",
    },
    'option actuatorgroupdisable="2"': {
        "joints": HINGE.format(""),
        "sections": f"<actuator>{DRIVE}</actuator>",
    },
    'flag clampctrl="disable"': {
        "joints": HINGE.format(""),
        "sections": '<actuator><motor joint="j" ctrlrange="9 10"/></actuator>',
    },
    # It disables what is not there.
    'flag gravity="enable" equality="disable"': {"joints": DAMPED},
}


def switched(text, setting):
    """A document with a setting, and a key frame to start from."""
    element, _, attribute = setting.strip().partition(" ")
    mine = attribute if element == "option" else ""
    flag = "" if element == "option" else f"<flag {attribute}/>"
    option = f'<option gravity="0 -9.81 0" integrator="RK4" {mine}>{flag}</option>'
    assert OPTION in text
    key = '<keyframe><key name="start"/></keyframe>'
    return text.replace(OPTION, option).replace("</mujoco>", f"{key}</mujoco>")


@pytest.mark.parametrize("setting", WORLDS)
def test_a_document_moves_as_in_mujoco_without_what_it_disables(setting):
    text = document(**WORLDS[setting])
    off = switched(text, setting)
    spec = from_mjcf(off)
    theirs = run_mujoco(off, spec, 200)
    assert distance(run_ours(spec, spec.params(), 200), theirs) < 1e-5
    on = run_mujoco(switched(text, "option"), spec, 200)
    is_empty = setting.startswith("flag gravity")
    assert is_empty or distance(on, theirs) > 0.1


def test_all_that_is_disabled_together_leaves_the_scene_of_a_bare_pin():
    joints = HINGE.format('damping="0.5" frictionloss="3" range="-0.2 0.3"')
    flags = 'flag damper="disable" frictionloss="disable" limit="disable"'
    spec = from_mjcf(switched(document(joints=joints), flags))
    (pin,) = spec.constraints
    assert "limit" not in pin.numbers
    assert float(pin.numbers["viscous"]) == 0.0


def test_disabled_constraints_leave_no_contact():
    text = document(geom='type="box" size="0.2 0.1 0.1"', joints=FREE).replace(
        "</worldbody>",
        f'<body name="other" pos="3 0 0">{FREE}<geom type="box" size="0.1 0.1 0.1"/>'
        "</body></worldbody>",
    )
    assert from_mjcf(text).bodies[0].has_contact
    off = switched(text, 'flag constraint="disable"')
    assert not from_mjcf(off).bodies[0].has_contact


def test_ends_are_where_their_margin_begins():
    joints = HINGE.format('range="-1 0.5" margin="0.1"')
    text = document(joints=joints)
    (pin,) = from_mjcf(text).constraints
    assert list(pin.numbers["limit"]) == pytest.approx([-0.9, 0.4])
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 2000)
    assert math.isclose(data.qpos[0], -0.9, abs_tol=2e-3)
