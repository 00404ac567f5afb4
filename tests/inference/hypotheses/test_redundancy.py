import itertools
import math

import numpy as np
import pytest

from boomdp_jax.inference.blocks.fixed_structure import fix_structure
from boomdp_jax.inference.hypotheses.layout import block_layout, structures
from boomdp_jax.inference.hypotheses.prior import DEFAULT_PROBABILITY, read_prior
from boomdp_jax.inference.hypotheses.redundancy import Tie, is_redundant
from boomdp_jax.physics import scene_spec_from_dict
from boomdp_jax.physics.params import WORLD


def spec(num_bodies, unknown, constraints=()):
    body = {"shape": {"type": "box", "half_extents": [0.2, 0.1]}, "pose": [0, 0, 0]}
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": 0.02,
            "bodies": [{"name": f"b{i}", **body} for i in range(num_bodies)],
            "unknown": unknown,
            "constraints": list(constraints),
        }
    )


def listed(scene):
    """Kinds and bodies of every structure, and its prior."""
    layout = block_layout(scene, tuple(range(scene.num_bodies)))
    rows, log_prior = structures(
        layout, scene.unknown, read_prior(scene.prior, scene.source)
    )
    names = [
        frozenset(
            (s.kind, s.body_a, s.body_b)
            for s, on in zip(layout.slots, row, strict=True)
            if on
        )
        for row in rows
    ]
    return dict(zip(names, np.exp(log_prior), strict=True))


ALL = {"revolute": 1, "prismatic": 1, "weld": 1, "ground": 1}


def test_a_body_is_free_pinned_in_a_drawer_or_welded():
    kinds = [sorted(kind for kind, _, _ in name) for name in listed(spec(1, ALL))]
    expected = [
        sorted([*joint, *floor])
        for joint in ([], ["revolute"], ["prismatic"])
        for floor in ([], ["ground"])
    ] + [["weld"]]
    assert sorted(kinds) == sorted(expected)


def test_what_is_left_keeps_its_proportions():
    prior = listed(spec(1, ALL))

    def weight(name):
        kinds = {kind for kind, _, _ in name}
        return math.prod(
            DEFAULT_PROBABILITY[kind]
            if kind in kinds
            else 1 - DEFAULT_PROBABILITY[kind]
            for kind in ALL
        )

    total = sum(map(weight, prior))
    for name, probability in prior.items():
        assert probability == pytest.approx(weight(name) / total)


def test_scenes_without_these_kinds_keep_every_structure():
    # Two pins hold a body as a weld does, but where no weld is known they stay.
    prior = listed(spec(1, {"revolute": 1, "distance": 1, "ground": 1}))
    assert len(prior) == 8
    layout = block_layout(spec(1, {"revolute": 2}), (0,))
    rows, _ = structures(layout, {"revolute": 2}, read_prior({}, "test"))
    assert rows.sum(1).tolist() == [0, 1, 2]


def test_two_pins_are_a_weld_where_there_are_welds():
    scene = spec(1, {"revolute": 2, "weld": 2})
    layout = block_layout(scene, (0,))
    rows, _ = structures(layout, scene.unknown, read_prior({}, "test"))
    assert sorted(rows.sum(1).tolist()) == [0, 1, 1]


def test_welded_bodies_are_listed_in_one_way():
    scene = spec(2, {"revolute": 1, "weld": 1})
    for name in listed(scene):
        ties = {(a, b) for kind, a, b in name if kind == "weld"}
        pins = {(a, b) for kind, a, b in name if kind == "revolute"}
        if (0, 1) in ties:
            # One group: its pin is the first body's, and the world is not in it.
            assert ties == {(0, 1)}
            assert pins <= {(0, WORLD)}
        # What is welded to the world has no pin of its own, and is the world to others.
        fixed = {a for a, b in ties if b == WORLD}
        assert not any(a in fixed or b in fixed for a, b in pins)


def test_a_known_weld_leaves_nothing_to_be_found():
    weld = {"type": "weld", "a": "b0", "b": "world", "anchor_a": [0, 0]}
    weld["anchor_b"] = [0, 0]
    scene = spec(1, {"revolute": 1, "prismatic": 1, "ground": 1}, [weld])
    assert list(listed(scene)) == [frozenset()]


def test_a_known_pin_leaves_no_drawer():
    pin = {"type": "revolute", "a": "b0", "b": "world", "anchor_a": [0, 0]}
    pin["anchor_b"] = [0, 0]
    names = list(listed(spec(1, {"prismatic": 1, "ground": 1}, [pin])))
    assert sorted(map(len, names)) == [0, 1]
    assert not any(kind == "prismatic" for name in names for kind, _, _ in name)


def test_known_constraints_alone_are_never_redundant():
    kinds = ("weld", "revolute", "prismatic", "ground")
    for num in range(5):
        for chosen in itertools.combinations(kinds, num):
            assert not is_redundant([Tie(kind, 0, WORLD, False) for kind in chosen])


def test_a_chain_of_welds_to_the_world_is_listed_as_welds_to_the_world():
    chain = [Tie("weld", 0, WORLD, True), Tie("weld", 0, 1, True)]
    star = [Tie("weld", 0, WORLD, True), Tie("weld", 1, WORLD, True)]
    assert is_redundant(chain)
    assert not is_redundant(star)
    assert is_redundant([*star, Tie("weld", 0, 1, True)])
    assert is_redundant([*star, Tie("ground", 1, WORLD, True)])


@pytest.mark.parametrize(
    "kinds", [["weld", "ground"], ["weld", "revolute"], ["prismatic", "revolute"]]
)
def test_a_user_cannot_ask_for_a_redundant_structure(kinds):
    with pytest.raises(ValueError, match="expected constraints that say more than"):
        fix_structure(spec(1, ALL), {"b0": kinds})
