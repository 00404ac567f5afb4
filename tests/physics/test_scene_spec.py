"""Scene files: what they say reaches the engine's arrays, and comes back."""

import copy
import json

import jax
import numpy as np
import pytest

from boomdp_jax.physics import WORLD
from boomdp_jax.physics.scene_file import load_scene, save_scene
from boomdp_jax.physics.scene_spec import scene_spec_from_dict


def _scene() -> dict:
    """A pinned table, a triangle drawn from its corner, a wall and a round pillar."""
    return {
        "schema": "planar-scene-1",
        "gravity": [0, 0],
        "dt": 0.02,
        "bodies": [
            {
                "name": "table",
                "label": "table",
                "pose": [0, 0, 0],
                "shape": {"type": "box", "half_extents": [0.6, 0.3]},
                "density": 20.0,
            },
            {
                "name": "wedge",
                "pose": [2, 0, 0.5],
                "twist": [0.1, 0.2, 0.3],
                "contact": {"friction": None, "restitution": 0.2},
                "shape": {"type": "polygon", "vertices": [[0, 0], [3, 0], [0, 1.5]]},
                "feet": [[0.5, 0.25], [2, 0.25], [0.5, 1]],
                "density": 10.0,
            },
            {
                "name": "wall",
                "pose": [0, 5, 0],
                "shape": {"type": "box", "half_extents": [4, 0.1]},
                "static": True,
            },
            {
                "name": "pillar",
                "pose": [0, -5, 0],
                "shape": {"type": "circle", "radius": 0.5},
                "density": 5.0,
            },
        ],
        "constraints": [
            {
                "type": "revolute",
                "a": "table",
                "b": "world",
                "anchor_a": [0.5, 0],
                "anchor_b": [0.5, 0],
            },
            {
                "type": "revolute",
                "a": "wedge",
                "b": "table",
                "anchor_a": [1, 0.5],
                "anchor_b": [-0.5, 0.1],
                "dry": 0.4,
            },
            {
                "type": "distance",
                "a": "pillar",
                "b": "wedge",
                "anchor_a": [0, 0.1],
                "anchor_b": [0, 0],
                "length": 4.0,
            },
            {
                "type": "wheel",
                "a": "wedge",
                "pose": [1.2, 0.7, 0.1],
                "viscous": [0, 50],
            },
            {"type": "wheel", "a": "wedge", "pose": [1, 0.5, 0], "dry": [1, 20]},
            {"type": "ground", "a": "table", "dry": 0.3},
        ],
        "unknown": {"wheel": 1},
        "prior": {"density": {"median": 30.0}},
    }


def _with_null(path: list, value: object = None) -> dict:
    """The scene with one value replaced."""
    scene = copy.deepcopy(_scene())
    inner = scene
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return scene


def test_outlines_reach_the_engine_about_the_centre_of_mass(precision):
    scene = scene_spec_from_dict(_scene()).scene
    assert scene.vertices.dtype == (np.float32 if precision.bits == 32 else np.float64)
    tolerance = precision.choose(single=1e-6, double=1e-12)
    # The centroid of the triangle is a third of its legs from the corner.
    np.testing.assert_allclose(
        scene.vertices[1],
        np.array([[-1, -0.5], [2, -0.5], [-1, 1], [-1, 1]]),
        atol=tolerance,
    )
    np.testing.assert_array_equal(
        scene.vertex_mask,
        np.array([[1, 1, 1, 1], [1, 1, 1, 0], [1, 1, 1, 1], [0, 0, 0, 0]], bool),
    )
    np.testing.assert_allclose(scene.radius, [0, 0, 0, 0.5])
    np.testing.assert_allclose(scene.area, [0.72, 2.25, 1.6, np.pi / 4], rtol=tolerance)
    np.testing.assert_allclose(
        scene.gyration[:2], [0.45 / 3, 11.25 / 18], rtol=tolerance
    )
    np.testing.assert_array_equal(scene.is_static, [False, False, True, False])


def test_feet_share_the_weight_about_the_centre_of_mass():
    scene = scene_spec_from_dict(_scene()).scene
    balance = np.einsum("bf,bfi->bi", scene.foot_load, scene.feet)
    np.testing.assert_allclose(balance, 0.0, atol=1e-12)
    np.testing.assert_allclose(np.sum(scene.foot_load, axis=-1), 1.0)
    np.testing.assert_allclose(scene.feet[1, 0], [-0.5, -0.25])
    assert scene.foot_load[1, 3] == 0


def test_known_constraints_become_active_slots():
    params = scene_spec_from_dict(_scene()).params()
    np.testing.assert_allclose(params.density, [20, 10, 1, 5])
    np.testing.assert_array_equal(params.revolute.active, [True, True])
    np.testing.assert_array_equal(params.revolute.body_a, [0, 1])
    np.testing.assert_array_equal(params.revolute.body_b, [WORLD, 0])
    # The wedge's anchor is its centroid, (1, 0.5) of its outline.
    np.testing.assert_allclose(params.revolute.anchor_a, [[0.5, 0], [0, 0]], atol=1e-12)
    np.testing.assert_allclose(params.revolute.anchor_b, [[0.5, 0], [-0.5, 0.1]])
    np.testing.assert_allclose(params.distance.anchor_b, [[-1, -0.5]])
    np.testing.assert_allclose(params.distance.length, [4])
    np.testing.assert_array_equal(
        params.wheel.active,
        np.array([[False, False], [True, True], [False, False], [False, False]]),
    )
    np.testing.assert_allclose(params.wheel.position[1, 0], [0.2, 0.2])
    np.testing.assert_allclose(params.wheel.heading[1], [0.1, 0])


def test_friction_that_is_left_out_follows_the_law():
    spec = scene_spec_from_dict(_scene())
    params = spec.params()
    # Neither given: no friction. Dry alone: the limit is reached at 0.02 rad/s.
    np.testing.assert_allclose(params.revolute.viscous, [0, 0.4 / 0.02])
    np.testing.assert_allclose(params.revolute.dry, [np.inf, 0.4])
    # Viscous alone: no limit. Dry alone: the limit is reached at 0.02 m/s.
    np.testing.assert_allclose(params.wheel.viscous[1], [[0, 50], [50, 1000]])
    np.testing.assert_allclose(params.wheel.dry[1], [[np.inf, np.inf], [1, 20]])
    # mu m g over 0.02 m/s.
    weight = 20 * 0.72 * 9.81
    np.testing.assert_allclose(params.ground.viscous[0], [0.3 * weight / 0.02])
    np.testing.assert_allclose(params.ground.dry[0], [0.3])


def test_ground_friction_of_an_unknown_mass_waits_for_the_mass():
    scene = _with_null(["bodies", 0, "density"])
    ground = scene_spec_from_dict(scene).constraints[-1]
    assert np.isnan(ground.numbers["viscous"])
    assert ground.derived == {"viscous"}
    assert ground.is_known


def test_null_numbers_are_to_be_inferred():
    spec = scene_spec_from_dict(_with_null(["constraints", 0, "anchor_b"], [None, 0.2]))
    pin = spec.constraints[0]
    assert not pin.is_known
    np.testing.assert_array_equal(pin.numbers["anchor_b"], [np.nan, 0.2])
    assert np.isnan(spec.bodies[1].friction)
    assert spec.bodies[1].restitution == 0.2
    assert spec.bodies[0].friction is None


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (["bodies", 0, "density"], r"body 'table': density: .* got unknown"),
        (["bodies", 0, "center_of_mass"], r"body 'table': center_of_mass"),
        (["constraints", 0, "anchor_a"], r"revolute of body 'table': anchor_a"),
        (["constraints", 1, "dry"], r"revolute of body 'wedge': viscous"),
        (["constraints", 2, "length"], r"distance of body 'pillar': length"),
        (["constraints", 3, "pose"], r"wheel of body 'wedge': position"),
        (["constraints", 5, "dry"], r"ground of body 'table': dry"),
    ],
)
def test_params_of_an_unknown_number_are_refused(path: list, message: str):
    spec = scene_spec_from_dict(_with_null(path), source="room.json")
    with pytest.raises(ValueError, match=rf"^room\.json: {message}"):
        spec.params()


def test_an_unknown_centre_of_mass_leaves_the_outline_where_it_is():
    spec = scene_spec_from_dict(_with_null(["bodies", 1, "center_of_mass"]))
    wedge = spec.bodies[1]
    assert wedge.is_center_unknown
    np.testing.assert_array_equal(wedge.shift, [0, 0])
    np.testing.assert_array_equal(wedge.vertices, wedge.outline)


def test_a_given_centre_of_mass_moves_outline_feet_and_anchors():
    spec = scene_spec_from_dict(_with_null(["bodies", 0, "center_of_mass"], [0.1, 0]))
    np.testing.assert_allclose(spec.bodies[0].vertices[0], [-0.7, -0.3])
    np.testing.assert_allclose(spec.constraints[0].numbers["anchor_a"], [0.4, 0])
    np.testing.assert_allclose(spec.constraints[0].numbers["anchor_b"], [0.5, 0])
    np.testing.assert_allclose(spec.constraints[1].numbers["anchor_b"], [-0.6, 0.1])
    assert any("'table'" in note for note in spec.notes)


def test_the_initial_state_is_what_the_file_says():
    state = scene_spec_from_dict(_scene()).initial_state()
    np.testing.assert_allclose(state.array[1], [2, 0, 0.5, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(state.twist[0], 0)


def test_a_body_without_a_pose_has_no_initial_state():
    scene = _scene()
    del scene["bodies"][1]["pose"]
    spec = scene_spec_from_dict(scene)
    np.testing.assert_array_equal(spec.pose[1], [np.nan] * 3)
    with pytest.raises(ValueError, match="scene: body 'wedge': pose: expected a pose"):
        spec.initial_state()


@pytest.mark.parametrize(
    ("changes", "normal_gravity"),
    [
        ({"gravity": [0, 0]}, 9.81),
        ({"gravity": [0, -9.81]}, 0.0),
        ({"gravity": [0, -9.81], "normal_gravity": 3.0}, 3.0),
    ],
)
def test_normal_gravity_is_there_where_the_plane_is_level(
    changes: dict, normal_gravity: float
):
    spec = scene_spec_from_dict({**_scene(), **changes})
    assert spec.normal_gravity == normal_gravity
    np.testing.assert_allclose(spec.scene.normal_gravity, normal_gravity)


def test_a_scene_may_say_in_how_many_parts_a_step_is_made():
    spec = scene_spec_from_dict({**_scene(), "substeps": 7})
    assert spec.scene.num_substeps == 7
    assert scene_spec_from_dict(spec.to_dict()).substeps == 7
    # Else it is two, or four where there is contact, and its file does not say.
    spec = scene_spec_from_dict({**_scene(), "substeps": None})
    assert (spec.substeps, spec.scene.num_substeps) == (None, 4)
    assert "substeps" not in spec.to_dict()


@pytest.mark.parametrize("value", [0, -1, 2.5, True, "2", 257])
def test_parts_of_a_step_are_counted(value):
    message = "scene: substeps: expected a whole number from 1 to 256, got "
    with pytest.raises(ValueError, match=message):
        scene_spec_from_dict({**_scene(), "substeps": value})


def test_a_missing_cap_is_zero():
    spec = scene_spec_from_dict(_scene())
    others = ("revolute", "distance", "prismatic", "weld", "ground")
    assert spec.unknown == {"wheel": 1, **dict.fromkeys(others, 0)}


@pytest.mark.parametrize("path", [None, ["bodies", 1, "center_of_mass"]])
def test_a_scene_survives_json(path: list | None):
    content = _scene() if path is None else _with_null(path)
    content["constraints"][0]["anchor_b"] = [None, 0.25]
    spec = scene_spec_from_dict(content)
    written = spec.to_dict()
    again = scene_spec_from_dict(json.loads(json.dumps(written, allow_nan=False)))
    for one, other in zip(
        jax.tree.leaves(spec.scene), jax.tree.leaves(again.scene), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    for one, other in zip(spec.constraints, again.constraints, strict=True):
        assert (one.kind, one.body_a, one.body_b) == (
            other.kind,
            other.body_a,
            other.body_b,
        )
        assert one.derived == other.derived
        for key, number in one.numbers.items():
            np.testing.assert_allclose(other.numbers[key], number, rtol=1e-14)
    assert written["bodies"][1]["shape"] == content["bodies"][1]["shape"]
    assert again.prior == content["prior"]
    assert again.unknown == spec.unknown
    assert again.to_dict()["bodies"] == written["bodies"]


def test_a_scene_is_the_same_under_a_trace_and_outside():
    spec = scene_spec_from_dict(_scene())
    total = jax.jit(lambda x: x * spec.scene.area.sum())(2.0)
    assert not isinstance(spec.scene.area, jax.core.Tracer)
    np.testing.assert_allclose(total, 2.0 * np.sum(spec.scene.area))
    assert spec.scene is spec.scene


def test_a_spec_is_hashed_by_identity():
    spec, other = scene_spec_from_dict(_scene()), scene_spec_from_dict(_scene())
    assert spec != other
    assert len({spec, other, spec}) == 2


def test_a_name_finds_its_body():
    spec = scene_spec_from_dict(_scene())
    assert spec.index("wall") == 2
    with pytest.raises(ValueError, match=r"expected one of table, .*, got 'chair'"):
        spec.index("chair")


def test_all_centres_of_mass_may_be_unknown_about_where_they_would_be():
    """What does not move has none to infer, and a file with null keeps its origin."""
    content = _with_null(["bodies", 1, "center_of_mass"])
    spec = scene_spec_from_dict(content)
    assert spec.is_center_unknown.tolist() == [False, True, False, False]
    del content["bodies"][1]["center_of_mass"], content["bodies"][1]["contact"]
    content["unknown"]["center_of_mass"] = True
    spec = scene_spec_from_dict(content)
    assert spec.is_center_unknown.tolist() == [True, True, False, True]
    np.testing.assert_allclose(spec.bodies[1].shift, [1.0, 0.5])
    written = json.loads(json.dumps(spec.to_dict()))
    again = scene_spec_from_dict(written)
    np.testing.assert_array_equal(again.is_center_unknown, spec.is_center_unknown)
    assert spec.params().center_of_mass is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"unknown": {"center_of_mass": 1}}, r"unknown\.center_of_mass: expected"),
        (
            {"unknown": {"center_of_mass": True}},
            r"body 'pillar': center_of_mass: expected the centre of the circle",
        ),
    ],
)
def test_an_unknown_centre_of_mass_that_makes_no_sense_is_refused(
    changes: dict, message: str
):
    with pytest.raises(ValueError, match=message):
        scene_spec_from_dict({**_scene(), **changes})


@pytest.mark.parametrize("kind", [np.float32, np.int64, np.array, jax.numpy.array])
def test_arrays_and_their_numbers_stand_for_lists_and_numbers(kind, tmp_path):
    content = {**_scene(), "gravity": np.zeros(2, int), "unknown": {}, "prior": {}}
    expected = scene_spec_from_dict(copy.deepcopy(content)).to_dict()
    table, wedge = content["bodies"][:2]
    table["density"], table["static"] = kind(20), np.False_
    table["pose"] = (kind(0), 0, np.zeros(()))
    wedge["shape"]["vertices"] = np.array(wedge["shape"]["vertices"], np.float32)
    wedge["feet"] = [np.array(foot) for foot in wedge["feet"]]
    content["unknown"] = {"wheel": np.int64(0)}
    spec = scene_spec_from_dict(content)
    assert spec.to_dict() == expected
    content["prior"] = {"density": {"center": kind(3)}}
    save_scene(scene_spec_from_dict(content), tmp_path / "scene.json")
    assert load_scene(tmp_path / "scene.json").prior == {"density": {"center": 3}}
    table["pose"] = np.zeros(2)
    with pytest.raises(ValueError, match=r"pose: expected a list of 3 .* got \[0.0, 0"):
        scene_spec_from_dict(content)


def test_numbers_of_the_actuator_may_be_unknown():
    content = {**_scene(), "unknown": {"wheel": 1, "actuator": ["delay", "gain"]}}
    spec = scene_spec_from_dict(content)
    assert spec.unknown_numbers == {"actuator.delay", "actuator.gain"}
    written = json.loads(json.dumps(spec.to_dict()))
    assert written["unknown"]["actuator"] == ["gain", "delay"]
    assert scene_spec_from_dict(written).unknown_numbers == spec.unknown_numbers
    for wrong in ("gain", ["drift"], [1], True):
        content["unknown"]["actuator"] = wrong
        with pytest.raises(ValueError, match=r"unknown\.actuator: expected a list"):
            scene_spec_from_dict(content)
