"""Documents outside the planar subset are refused, and the message says where."""

import importlib
import math

import pytest

from boomdp_jax.interop import from_mjcf
from tests.interop.mjcf_documents import BOX, BRAKE, FREE, QUIET, document

HINGE = '<joint name="j" type="hinge" axis="0 0 1" {}/>'
SITES = '<site name="s"/>'


def brakes(*places, bias="0 0 -3"):
    rows = "".join(BRAKE.format(bias=bias, place=place) for place in places)
    return f"<actuator>{rows}</actuator>"


def octagon(site, limits=(1, 1, 1, 1)):
    return [
        f'site="{site}" gear="{math.cos(k * math.pi / 4)} {math.sin(k * math.pi / 4)}'
        f' 0 0 0 0" forcelimited="true" forcerange="{-limit} {limit}"'
        for k, limit in enumerate(limits)
    ]


PLANK = f'<body name="plank" pos="1 0 0">{FREE}<geom {BOX}/></body>'


def stopped(fields):
    """A hinge with ends."""
    return document(joints=HINGE.format(f'limited="true" range="-1 1" {fields}'))


def nailed(fields):
    """A body that an equality holds to the world."""
    tie = f'<equality><weld body1="thing" {fields}/></equality>'
    return document(sections=tie)


def flagged(text, flag):
    option = '<option gravity="0 -9.81 0"'
    return text.replace(f"{option}/>", f'{option}><flag {flag}="enable"/></option>')


SOFT = "expected a constraint that is hard, with a time constant of at most 0.1 s"
REFUSALS = {
    "not a document": (
        "<mujoco><nonsense/></mujoco>",
        "expected MJCF that MuJoCo reads",
    ),
    "free joint": (
        document(joints="<freejoint/>"),
        "expected a hinge or a slide, got free",
    ),
    "free sphere": (
        document(joints="<freejoint/>", geom='type="sphere" size="0.1"'),
        "joint 'joint0': expected a hinge or a slide, got free",
    ),
    "tilted hinge": (
        document(joints='<joint type="hinge" axis="0 1 1"/>'),
        "joint 'joint0': expected an axis along z",
    ),
    "tilted slide": (
        document(joints='<joint type="slide" axis="0 1 1"/>'),
        "joint 'joint0': expected an axis in the x-y plane",
    ),
    "tilted body": (
        document(joints=FREE, world="").replace('pos="0 0.6 0"', 'euler="0.1 0 0"'),
        "body 'thing': expected a frame whose z axis is the world's",
    ),
    "two hinges": (
        document(joints=HINGE.format("") + '<joint type="hinge" axis="0 0 1"/>'),
        "body 'thing': expected no joint, one hinge, one slide",
    ),
    "parallel slides": (
        document(joints=FREE.replace("0 1 0", "1 0 0")),
        "body 'thing': expected slides along two directions",
    ),
    "damped slide": (
        document(joints=FREE.replace('"1 0 0"', '"1 0 0" damping="1"')),
        "expected no damping in a body that is free",
    ),
    "spring": (
        document(joints=HINGE.format('stiffness="2"')),
        "joint 'j': expected no stiffness, got",
    ),
    "armature": (
        document(joints=HINGE.format('armature="2"')),
        "joint 'j': expected no armature, got",
    ),
    "damping and loss": (
        document(joints=HINGE.format('damping="1" frictionloss="2"')),
        "joint 'j': expected one law of friction",
    ),
    "bent damping": (
        document(joints=HINGE.format('damping="1 2"')),
        "joint 'j': expected linear damping",
    ),
    "two geoms": (
        document(more=f"<geom {QUIET}/>"),
        "expected one geom for its outline, got 2 of which 0 can touch others",
    ),
    "capsule": (
        document(geom='type="capsule" size="0.1 0.1" contype="0" conaffinity="0"'),
        "geom 'skin': expected a box, sphere, cylinder or mesh, got capsule",
    ),
    "lying cylinder": (
        document(geom='type="cylinder" size="0.1 0.1" euler="1.57079 0 0"'),
        "geom 'skin': expected a cylinder along z",
    ),
    "pyramid": (
        document(geom='type="mesh" mesh="m"').replace(
            "<worldbody>",
            '<asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>'
            "<worldbody>",
        ),
        "geom 'skin': expected an upright prism",
    ),
    "sphere": (
        document(geom='type="sphere" size="0.1"'),
        "body 'thing': expected the inertia of its outline",
    ),
    "eccentric circle": (
        document(
            geom='type="cylinder" size="0.1 0.1"',
            more='<inertial pos="0.1 0 0" mass="2" diaginertia="0.01 0.01 0.01"/>',
        ),
        "body 'thing': expected the centre of mass in that of its circle",
    ),
    "marionette": (
        document(others='<body name="hand" mocap="true"/>'),
        "body 'hand': expected no motion capture",
    ),
    "floating": (
        document().replace('<body name="thing"', '<body name="thing" gravcomp="1"'),
        "body 'thing': expected gravcomp 0",
    ),
    "floor": (
        document(world='<geom name="floor" type="plane" size="1 1 1"/>', geom=BOX),
        "geom 'floor': expected a plane that stands upright",
    ),
    "joint equality": (
        document(
            joints=HINGE.format(""),
            sections='<equality><joint joint1="j"/></equality>',
        ),
        "equality 'equality0': expected connect, weld or one tendon, got joint",
    ),
    "tie of nothing": (
        document(
            world='<site name="u"/><site name="v"/>',
            sections='<equality><connect site1="u" site2="v"/></equality>',
        ),
        "equality 'equality0': expected a body that can move",
    ),
    "long tendon": (
        document(
            more='<site name="u"/><site name="v" pos="1 0 0"/>'
            '<site name="w" pos="2 0 0"/>',
            sections='<tendon><spatial name="t"><site site="u"/><site site="v"/>'
            '<site site="w"/></spatial></tendon><equality><tendon tendon1="t"/>'
            "</equality>",
        ),
        "expected one tendon between two sites",
    ),
    "servo": (
        document(
            joints=HINGE.format(""),
            sections='<actuator><position joint="j"/></actuator>',
        ),
        "expected a direct force, or gain 0 and a bias that falls with speed",
    ),
    "uneven limits": (
        document(
            joints=HINGE.format(""),
            sections=brakes('joint="j" forcelimited="true" forcerange="-1 2"'),
        ),
        "expected a symmetric force range",
    ),
    "weak motor": (
        document(joints=HINGE.format(""), sections=brakes('joint="j"', bias="1 0 -3")),
        "expected a gain of the force limit over 0.02",
    ),
    "two motors": (
        document(
            joints=HINGE.format(""),
            sections=brakes(
                *['joint="j" forcelimited="true" forcerange="-2 2"'] * 2,
                bias="1 0 -100",
            ),
        ),
        "joint 'j': expected one law of motor",
    ),
    "spin brake": (
        document(more=SITES, sections=brakes('site="s" gear="0 0 0 0 0 1"')),
        "expected brakes of joints, or along the plane of sites",
    ),
    "brake of nothing": (
        document(world=SITES, sections=brakes('site="s" gear="1 0 0 0 0 0"')),
        "site 's': expected a body that can move",
    ),
    "skew wheel": (
        document(
            more=SITES,
            sections=brakes(
                'site="s" gear="1 0 0 0 0 0"', 'site="s" gear="1 1 0 0 0 0"'
            ),
        ),
        "site 's': expected one force, two at a right angle",
    ),
    "uneven foot": (
        document(more=SITES, sections=brakes(*octagon("s", (1, 2, 1, 1)))),
        "site 's': expected equal forces along four directions",
    ),
    "foot without weight": (
        document(more=SITES, sections=brakes(*octagon("s"))),
        "body 'thing': expected gravity towards its floor",
    ),
    "feet off balance": (
        document(
            more='<site name="s" pos="0.1 0 0"/><site name="t" pos="-0.2 0 0"/>',
            sections=brakes(*octagon("s"), *octagon("t")),
        ),
        "body 'thing': expected feet that share the load",
    ),
    "heavy tendon": (
        document(
            joints=HINGE.format(""),
            sections='<tendon><fixed name="t" armature="0.2"><joint joint="j" '
            'coef="1"/></fixed></tendon>',
        ),
        "option: expected tendons without armature, got 0.2",
    ),
    "heavy drive": (
        document(
            joints=HINGE.format(""),
            sections='<actuator><motor joint="j" armature="0.1"/></actuator>',
        ),
        "actuator 'actuator0': expected no armature, got",
    ),
    "damped drive": (
        document(
            joints=HINGE.format(""),
            sections='<actuator><motor joint="j" damping="0.1"/></actuator>',
        ),
        "actuator 'actuator0': expected no damping, got",
    ),
    "drive that cannot rest": (
        document(
            joints=HINGE.format(""),
            sections='<actuator><motor joint="j" ctrlrange="1 2"/></actuator>',
        ),
        r"actuator 'actuator0': expected a ctrlrange about 0, got \(1.0, 2.0\)",
    ),
    "soft ends": (
        stopped('solreflimit="0.2 1"'),
        rf"joint 'j': {SOFT} \(here 0.2 s\), got solreflimit 0.2 1 and solimplimit",
    ),
    "soft ends as a spring": (
        stopped('solreflimit="-25 -10"'),
        rf"joint 'j': {SOFT} \(here 0.2 s\), got solreflimit -25 -10",
    ),
    "slow ends": (stopped('solreflimit="0.02 10"'), SOFT),
    "ends that begin softly": (
        stopped('solimplimit="0 0.95 1"'),
        rf"{SOFT} .* solimplimit 0 0.95 1 0.5 2",
    ),
    "ends that throw back": (
        stopped('solreflimit="0.02 0.2"'),
        "joint 'j': expected a stop that does not throw back, .*ratio of 0.3, got",
    ),
    "ends without damping": (
        stopped('solreflimit="-1000 0"'),
        "joint 'j': expected a constraint with stiffness and damping, got",
    ),
    "soft friction": (
        document(joints=HINGE.format('frictionloss="1" solreffriction="0.5 1"')),
        rf"joint 'j': {SOFT} .*, got solreffriction 0.5 1 and solimpfriction",
    ),
    "soft weld": (
        nailed('solref="0.3 1"'),
        rf"equality 'equality0': {SOFT} .*, got solref 0.3 1 and solimp 0.9",
    ),
    "soft equalities of a class": (
        nailed("").replace(
            "<worldbody>",
            '<default><equality solref="0.3 1"/></default><worldbody>',
        ),
        rf"equality 'equality0': {SOFT}",
    ),
    "weld that turns": (
        nailed('torquescale="0"'),
        "equality 'equality0': expected a torquescale above 0, got 0",
    ),
    "soft contact": (
        document(geom=f'{BOX} solref="0.3 1"', others=PLANK),
        rf"geom 'skin': {SOFT} .*, got solref 0.3 1 and solimp 0.9",
    ),
    "soft contact of a pair": (
        document(
            geom=BOX,
            others=PLANK,
            sections='<contact><pair geom1="skin" geom2="top" solref="0.3 1"/>'
            "</contact>",
        ).replace(f"{FREE}<geom {BOX}", f'{FREE}<geom name="top" {BOX}'),
        rf"pair 'pair0': {SOFT}",
    ),
    "contact from afar": (
        document(geom=f'{BOX} margin="0.05"', others=PLANK),
        "geom 'skin': expected a margin of at most 0.01, got 0.05",
    ),
    "contact of options": (
        flagged(document(geom=BOX, others=PLANK), "override"),
        "option: expected no flag override where bodies touch",
    ),
    "asleep": (
        flagged(document(), "sleep").replace(
            '<body name="thing"', '<body name="thing" sleep="init"'
        ),
        "option: expected no flag sleep where bodies start asleep",
    ),
    "wind": (
        document().replace('gravity="0 -9.81 0"', 'density="1.2"'),
        "option: expected density 0, got 1.2",
    ),
    "gravity upwards": (
        document().replace('gravity="0 -9.81 0"', 'gravity="0 0 1"'),
        "option: expected no gravity upwards",
    ),
    "frictions": (
        document(geom=f'{BOX} friction="0.2"', others=PLANK),
        "geom 'skin': expected a friction with .* got 1",
    ),
    "contact of tied bodies": (
        document(
            geom=BOX,
            others=PLANK,
            sections='<equality><connect body1="thing" body2="plank" anchor="0 0 0"/>'
            "</equality>",
        ),
        "expected no contact of bodies that are tied",
    ),
    "contact without groups": (
        document(
            geom=BOX,
            others=PLANK
            + PLANK.replace('"plank" pos="1', '"quiet" pos="2').replace(
                BOX, f'{BOX} contype="2" conaffinity="2"'
            ),
        ),
        "contact: expected groups that do not touch",
    ),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_what_is_outside_the_subset_is_refused(name, tmp_path, monkeypatch):
    # MuJoCo writes its warnings, of singular worlds here, where it is.
    monkeypatch.chdir(tmp_path)
    text, message = REFUSALS[name]
    with pytest.raises(ValueError, match=message):
        from_mjcf(text)


def test_mujoco_is_asked_for(monkeypatch):
    def no_mujoco(name):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", no_mujoco)
    with pytest.raises(ImportError, match=r"pip install 'boomdp_jax\[test\]'"):
        from_mjcf(document())
