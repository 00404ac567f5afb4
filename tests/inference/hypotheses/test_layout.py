import math

import numpy as np
import pytest

from boomdp_jax.inference.hypotheses.layout import block_layout, structures
from boomdp_jax.inference.hypotheses.prior import DEFAULT_PROBABILITY, read_prior
from boomdp_jax.physics import scene_spec_from_dict
from boomdp_jax.physics.constraint_spec import KINDS


def spec(num_bodies, unknown, **fields):
    body = {"shape": {"type": "box", "half_extents": [0.2, 0.1]}, "pose": [0, 0, 0]}
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": 0.02,
            "bodies": [{"name": f"b{i}", **body} for i in range(num_bodies)],
            "unknown": unknown,
            **fields,
        }
    )


def listed(scene, **load):
    layout = block_layout(scene, tuple(range(scene.num_bodies)))
    options = read_prior(scene.prior, scene.source)
    return layout, *structures(layout, scene.unknown, options, **load)


def test_one_body_with_three_optional_constraints_has_eight_structures():
    _, rows, log_prior = listed(spec(1, {"revolute": 1, "wheel": 1, "ground": 1}))
    assert rows.shape == (8, 3)
    kinds = ("revolute", "wheel", "ground")
    for row, value in zip(rows, log_prior, strict=True):
        expected = math.prod(
            DEFAULT_PROBABILITY[k] if on else 1 - DEFAULT_PROBABILITY[k]
            for k, on in zip(kinds, row, strict=True)
        )
        assert math.exp(value) == pytest.approx(expected)


def test_exchangeable_slots_are_listed_once_with_binomial_prior():
    _, rows, log_prior = listed(spec(1, {"wheel": 2}))
    assert rows.tolist() == [[False, False], [True, False], [True, True]]
    p = DEFAULT_PROBABILITY["wheel"]
    expected = [(1 - p) ** 2, 2 * p * (1 - p), p**2]
    np.testing.assert_allclose(np.exp(log_prior), expected)


def test_a_tie_counts_against_the_caps_of_both_bodies():
    layout, rows, log_prior = listed(spec(2, {"revolute": 1}))
    ends = [(s.body_a, s.body_b) for s in layout.slots]
    assert sorted(ends) == [(0, -1), (0, 1), (1, -1)]
    tie = ends.index((0, 1))
    assert not any(row[tie] and row.sum() > 1 for row in rows)
    assert len(rows) == 5
    assert np.exp(log_prior).sum() == pytest.approx(1.0)


def test_a_scene_without_load_has_neither_wheels_nor_ground():
    scene = spec(1, {"revolute": 1, "wheel": 1, "ground": 1}, gravity=[0.0, -9.81])
    layout, rows, log_prior = listed(scene, is_loaded=False)
    kinds = np.array([slot.kind for slot in layout.slots])
    possible = rows[np.isfinite(log_prior)]
    assert len(possible) == 2
    assert not possible[:, kinds != "revolute"].any()
    # What is left keeps its proportions.
    np.testing.assert_allclose(np.sort(np.exp(log_prior))[-2:], [0.2, 0.8])


def test_coordinates_of_slots_do_not_overlap():
    unknown = {"revolute": 1, "distance": 1, "wheel": 2, "ground": 1}
    layout, _, _ = listed(spec(2, unknown))
    slot = layout.slot_of_coordinate()
    assert slot.shape == (layout.dim,)
    assert list(np.flatnonzero(slot < 0)) == [0, 1]
    counts = np.bincount(slot[2:])
    sizes = {"revolute": 6, "distance": 5, "wheel": 8, "ground": 9}
    assert counts.tolist() == [sizes[s.kind] for s in layout.slots]
    assert np.count_nonzero(layout.period()) == 4


@pytest.mark.parametrize(
    ("num_bodies", "unknown", "what"),
    [
        (1, {"revolute": 50}, "50 constraints .* expected at most 12"),
        (1, dict.fromkeys(KINDS, 3), "18 constraints .* expected at most 12"),
        (4, {"revolute": 3, "wheel": 3, "ground": 3}, "expected at most 4096"),
    ],
)
def test_too_many_structures_are_refused(num_bodies, unknown, what):
    with pytest.raises(ValueError, match=f"unknown: .*{what}; lower the caps"):
        listed(spec(num_bodies, unknown))


def test_what_is_refused_is_named_with_its_file():
    scene = spec(1, {"revolute": 50})
    layout = block_layout(scene, (0,))
    options = read_prior(scene.prior, scene.source)
    with pytest.raises(ValueError, match=r"^room\.json: unknown: 50 constraints"):
        structures(layout, scene.unknown, options, source="room.json")


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        ({"densty": {}}, "expected one of density"),
        ({"density": {"center": -1.0}}, "expected a positive median, got -1.0"),
        ({"density": {"spread": 0.0}}, "a positive spread"),
        ({"density": {"median": 3.0}}, "expected one of center, spread"),
        ({"probability": {"wheel": 1.5}}, "wheel: expected 0 to 1, got 1.5"),
        ({"noise": {"angle": 0.0}}, "angle: expected a positive scale"),
        ({"density": 3.0}, "expected an object, got 3.0"),
    ],
)
def test_a_prior_that_makes_no_sense_is_refused(prior, message):
    with pytest.raises(ValueError, match=message):
        read_prior(prior, "scene.json")


def test_a_prior_override_replaces_only_what_it_names():
    options = read_prior(
        {"density": {"center": 5.0}, "probability": {"wheel": 0.0}}, "scene.json"
    )
    assert options.scales["density"].center == 5.0
    assert options.scales["density"].spread == 1.5
    assert options.probability["wheel"] == 0.0
    assert options.probability["ground"] == DEFAULT_PROBABILITY["ground"]
