"""What is said of a start that joints do not hold, against gaps told by hand."""

import math

import equinox as eqx
import jax.numpy as jnp
import pytest

from boomdp_jax.physics.scene_spec import scene_spec_from_dict
from boomdp_jax.physics.start_gaps import start_gaps

BOX = {"type": "box", "half_extents": [0.5, 0.3]}


def spec_of(joint, pose):
    """A box joined to the world, or to a block at (2, 0) that is turned left."""
    block = {"name": "block", "pose": [2, 0, math.pi / 2], "shape": BOX, "density": 1.0}
    box = {"name": "box", "pose": list(pose), "shape": BOX, "density": 1.0}
    ends = {"a": "box", "b": "world", "anchor_a": [0, 0], "anchor_b": [0, 0]}
    content = {"schema": "planar-scene-1", "dt": 0.02, "bodies": [block, box]}
    return scene_spec_from_dict(content | {"constraints": [ends | joint]})


def pin(**fields):
    return {"type": "revolute", **fields}


def rod(length):
    return {"type": "distance", "length": length}


def guide(**fields):
    return {"type": "prismatic", "axis": 0.0, **fields}


WELD = {"type": "weld", "angle": 0.1}
AT_ORIGIN, ASIDE = (0.0, 0.0, 0.0), (3.0, 4.0, 0.0)
CASES = {
    "pin": (pin(anchor_b=[5, 0]), AT_ORIGIN, ["5 m off its pin to the world"]),
    "pin of a block": (
        pin(b="block", anchor_b=[0, 2.5]),
        AT_ORIGIN,
        ["0.5 m off its pin to body 'block'"],
    ),
    "pin that holds": (pin(b="block", anchor_b=[0, 2]), AT_ORIGIN, []),
    "rounding": (pin(anchor_b=[0.0009, 0]), AT_ORIGIN, []),
    "rod": (rod(4.0), ASIDE, ["1 m off its rod to the world"]),
    "rod that holds": (rod(5.0), ASIDE, []),
    "weld": (
        WELD,
        (0.0, 0.25, 0.3),
        ["0.25 m off its weld to the world", "0.2 rad off its weld to the world"],
    ),
    "guide": (guide(), (7.0, 0.5, 0.0), ["0.5 m off its guide to the world"]),
    # The block's axis points up.
    "guide that holds": (guide(b="block"), (2.0, 7.0, math.pi / 2), []),
}


RANGE = {"lower": -0.5, "upper": 0.5}
RANGE_CASES = {
    "pin above": (
        pin(**RANGE),
        (0.0, 0.0, 2.0),
        ["1.5 rad outside the range of its pin to the world"],
    ),
    "pin below": (
        pin(b="block", anchor_b=[-0.3, 2], lower=-1.0),
        (0.0, -0.3, 0.0),
        ["0.571 rad outside the range of its pin to body 'block'"],
    ),
    # Whole turns count.
    "pin a turn ahead": (
        pin(**RANGE),
        (0.0, 0.0, 2.0 * math.pi),
        ["5.78 rad outside the range of its pin to the world"],
    ),
    "pin at its end": (pin(**RANGE), (0.0, 0.0, 0.5), []),
    "rounding of an end": (pin(**RANGE), (0.0, 0.0, 0.5009), []),
    "one end": (pin(lower=-0.5), (0.0, 0.0, 9.0), []),
    "guide": (
        guide(**RANGE),
        (2.0, 0.0, 0.0),
        ["1.5 m outside the range of its guide to the world"],
    ),
    "guide that turned with its block": (
        guide(b="block", axis=0.0, upper=3.0),
        (2.0, 7.0, math.pi / 2),
        ["4 m outside the range of its guide to body 'block'"],
    ),
    "guide within": (guide(b="block", upper=8.0), (2.0, 7.0, math.pi / 2), []),
    "both": (
        pin(anchor_b=[5, 0], **RANGE),
        (0.0, 0.0, -0.6),
        [
            "5 m off its pin to the world",
            "0.1 rad outside the range of its pin to the world",
        ],
    ),
}


@pytest.mark.parametrize("case", RANGE_CASES.values(), ids=RANGE_CASES)
def test_what_is_outside_a_range_is_told(case):
    joint, pose, expected = case
    spec = spec_of(joint, pose)
    said = start_gaps(spec.params(), spec.initial_state(), spec.names)
    assert said == [f"body 'box' starts {gap}" for gap in expected]


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_what_is_off_is_told(case):
    joint, pose, expected = case
    spec = spec_of(joint, pose)
    said = start_gaps(spec.params(), spec.initial_state(), spec.names)
    assert said == [f"body 'box' starts {gap}" for gap in expected]


def test_a_joint_that_is_absent_is_not_told():
    spec = spec_of(pin(anchor_b=[5, 0]), AT_ORIGIN)
    params = spec.params()
    absent = eqx.tree_at(lambda p: p.revolute.active, params, jnp.zeros(1, bool))
    assert start_gaps(absent, spec.initial_state(), spec.names) == []
