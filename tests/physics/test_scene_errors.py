"""Bad scene files: one line with file, body or field, what was expected and got."""

import copy
import json
import math
from pathlib import Path

import pytest

from boomdp_jax.physics.scene_file import MAX_SCENE_BYTES, load_scene, save_scene
from boomdp_jax.physics.scene_spec import scene_spec_from_dict

_DELETE = object()


def _scene() -> dict:
    return {
        "schema": "planar-scene-1",
        "gravity": [0, 0],
        "dt": 0.02,
        "bodies": [
            {
                "name": "cart",
                "pose": [0, 0, 0],
                "shape": {"type": "box", "half_extents": [0.5, 0.3]},
                "density": 10.0,
            },
            {
                "name": "wall",
                "pose": [0, 5, 0],
                "shape": {
                    "type": "polygon",
                    "vertices": [[0, 0], [1, 0], [1, 1], [0, 1]],
                },
                "static": True,
            },
        ],
        "constraints": [
            {
                "type": "revolute",
                "a": "cart",
                "b": "world",
                "anchor_a": [0, 0],
                "anchor_b": [0, 0],
            },
            {"type": "wheel", "a": "cart", "pose": [0, 0, 0], "viscous": [0, 1]},
            {"type": "ground", "a": "cart", "dry": 0.3},
            {
                "type": "distance",
                "a": "cart",
                "b": "wall",
                "anchor_a": [0, 0],
                "anchor_b": [0, 0],
                "length": 4.5,
            },
        ],
        "unknown": {"revolute": 1},
        "prior": {},
    }


def _changed(path: tuple, value: object) -> dict:
    scene = copy.deepcopy(_scene())
    inner = scene
    for key in path[:-1]:
        inner = inner[key]
    if value is _DELETE:
        del inner[path[-1]]
    else:
        inner[path[-1]] = value
    return scene


CART, WALL = ("bodies", 0), ("bodies", 1)
PIN, WHEEL, GROUND, ROD = (("constraints", i) for i in range(4))
DENT = [[0, 0], [2, 0], [0.5, 0.5], [0, 2]]
CLOCKWISE = [[0, 0], [0, 1], [1, 1], [1, 0]]


def test_the_unchanged_scene_is_fine():
    assert scene_spec_from_dict(_scene()).names == ("cart", "wall")


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("schema",), "planar-scene-2", r"schema: expected 'planar-scene-1', got 'pl"),
        (("schema",), _DELETE, r"schema: expected 'planar-scene-1', got None"),
        (("bodys",), [], r"\(did you mean 'bodies'\?\), got 'bodys'"),
        (("bodies",), _DELETE, r"expected a field 'bodies', got"),
        (("bodies",), [], r"bodies: expected at least one body"),
        (("bodies",), {}, r"bodies: expected a list, got {}"),
        (("dt",), _DELETE, r"expected a field 'dt'"),
        (("dt",), 0, r"dt: expected a finite number above 0, got 0"),
        (("dt",), -0.02, r"dt: expected a finite number above 0, got -0.02"),
        (("dt",), "0.02", r"dt: expected a finite number above 0, got '0.02'"),
        (("dt",), True, r"dt: expected a finite number above 0, got True"),
        (("gravity",), [0, math.nan], r"gravity\[1\]: expected a finite number, got n"),
        (("gravity",), 9.81, r"gravity: expected a list of 2 numbers, got 9.81"),
        (("normal_gravity",), -1, r"normal_gravity: expected .* at least 0, got -1"),
        (("unknown", "wheels"), 1, r"unknown: .*'wheel'\?\), got 'wheels'"),
        (("unknown", "wheel"), -1, r"unknown.wheel: expected a whole .* got -1"),
        (("unknown", "wheel"), 1.5, r"unknown.wheel: expected a whole .* got 1.5"),
        (("unknown", "wheel"), True, r"unknown.wheel: expected a whole .* got True"),
        (("prior",), [], r"prior: expected an object, got \[\]"),
        (("prior", "x"), [1, math.inf], r"prior.x\[1\]: expected a finite number"),
        (
            ("unknown", "actuator"),
            ["gain", "gain"],
            r"unknown.actuator: expected names that differ, got 'gain twice'",
        ),
        ((*CART, "densty"), 1, r"body 'cart': .*'density'\?\), got 'densty'"),
        ((*CART, "name"), _DELETE, r"bodies\[0\]: expected a field 'name'"),
        ((*CART, "name"), "", r"body '': name: expected a printable name"),
        ((*CART, "name"), 3, r"bodies\[0\]: name: expected a printable name, got 3"),
        ((*CART, "name"), "a\nb", r"name: expected a printable name, got 'a\\nb'"),
        ((*CART, "name"), "world", r"expected a name other than the world's"),
        ((*CART, "name"), "wall", r"bodies: expected names that differ, got 'wall tw"),
        ((*CART, "label"), 3, r"body 'cart': label: expected a printable name, got 3"),
        ((*CART, "density"), 0, r"'cart': density: .* above 0 or null, got 0"),
        ((*CART, "density"), -2.0, r"'cart': density: .* above 0 or null, got -2.0"),
        ((*CART, "density"), 1e30, r"density: expected a number of at most 1e\+15"),
        ((*CART, "shape", "half_extents"), [1e-9, 1e-12], r"shape: expected an area"),
        ((*CART, "density"), 10**400, r"'cart': density: expected a finite number"),
        ((*CART, "static"), 1, r"'cart': static: expected true or false, got 1"),
        ((*CART, "pose"), [0, 0], r"'cart': pose: expected a list of 3 numbers"),
        ((*CART, "pose"), [0, 0, None], r"'cart': pose\[2\]: expected a finite number"),
        ((*CART, "twist"), "no", r"'cart': twist: expected a list of 3 numbers"),
        ((*CART, "feet"), [], r"'cart': feet: expected at least one point"),
        ((*CART, "feet"), [[0, 0, 0]], r"'cart': feet\[0\]: expected a list of 2"),
        ((*CART, "contact"), {"fricton": 1}, r"contact: .*'friction'\?\), got 'frict"),
        ((*CART, "contact"), {"friction": -1}, r"contact.friction: .* at least 0"),
        ((*CART, "contact"), {"restitution": 2}, r"contact.restitution: .* 0 to 1"),
        ((*CART, "center_of_mass"), [0], r"center_of_mass: expected a list of 2"),
        (
            (*CART, "center_of_mass"),
            [5, 5],
            r"'cart': center_of_mass: expected a point of the .* got \[5.0, 5.0\]",
        ),
        ((*CART, "center_of_mass"), [0, 0.31], r"center_of_mass: .* \[0.0, 0.31\]"),
        ((*CART, "shape"), None, r"'cart': shape: expected an object, got None"),
        ((*CART, "shape", "type"), "blob", r"shape.type: expected box, polygon or cir"),
        ((*CART, "shape", "radius"), 1, r"shape: expected fields .* got 'radius'"),
        ((*CART, "shape", "half_extents"), [1, 0], r"half_extents\[1\]: .* above 0"),
        ((*CART, "shape"), {"type": "circle"}, r"shape: expected a field 'radius'"),
        ((*CART, "shape"), {"type": "circle", "radius": -1}, r"radius: .* above 0"),
        ((*WALL, "shape", "vertices"), DENT, r"'wall': shape.vertices: .* convex"),
        ((*WALL, "shape", "vertices"), CLOCKWISE, r"'wall': .*got them clockwise"),
        (
            (*WALL, "shape", "vertices"),
            DENT[:2],
            r"'wall': .*3 corners, got 2",
        ),
        ((*WALL, "pose"), _DELETE, r"'wall': pose: expected a pose, .* static"),
        ((*WALL, "twist"), [1, 0, 0], r"'wall': twist: expected zeros"),
        (("constraints",), {}, r"constraints: expected a list"),
        ((*PIN, "type"), "hinge", r"constraints\[0\]: type: expected one of .*'hinge'"),
        ((*PIN, "type"), None, r"constraints\[0\]: type: expected one of .*got None"),
        (
            (*PIN, "a"),
            "chart",
            r"\(revolute\): a: expected the name .*'chart'",
        ),
        ((*PIN, "b"), "floor", r"\(revolute\): b: expected the name .* got 'floor'"),
        ((*PIN, "b"), "cart", r"b: expected another body than a, got 'cart'"),
        ((*PIN, "a"), "wall", r"a: expected a body that can move, got 'wall'"),
        ((*PIN, "anchor_a"), _DELETE, r"\(revolute\): expected a field 'anchor_a'"),
        ((*PIN, "anchor_a"), [0, "x"], r"anchor_a\[1\]: expected a finite number or n"),
        ((*PIN, "anchr"), [0, 0], r"\(revolute\): expected fields .* got 'anchr'"),
        ((*PIN, "dry"), -1, r"dry: expected a finite number of at least 0 or null"),
        (
            (*WHEEL, "viscous"),
            3,
            r"\(wheel\): viscous: expected a list of 2 num",
        ),
        ((*WHEEL, "viscous"), [0, -1], r"\(wheel\): viscous\[1\]: .* at least 0"),
        (
            (*WHEEL, "viscous"),
            _DELETE,
            r"\(wheel\): expected a field 'viscous' or",
        ),
        ((*WHEEL, "a"), "wall", r"\(wheel\): a: expected a body that can move"),
        ((*GROUND, "dry"), [1, 2], r"\(ground\): dry: expected a finite number"),
        ((*ROD, "length"), 0, r"\(distance\): length: .* above 0 or null, got 0"),
        ((*ROD, "viscous"), 1, r"\(distance\): expected fields .* got 'viscous'"),
    ],
)
def test_a_bad_field_is_refused_by_name(
    tmp_path: Path, path: tuple, value: object, message: str
):
    with pytest.raises(ValueError, match=message) as caught:
        scene_spec_from_dict(_changed(path, value), source="room.json")
    assert str(caught.value).startswith("room.json: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("center", [[0.5, 0.3], [-0.5, 0.0], [0.1 + 0.2, -0.3]])
def test_a_centre_of_mass_may_lie_on_the_edge(center: list):
    spec = scene_spec_from_dict(_changed((*CART, "center_of_mass"), center))
    assert spec.bodies[0].shift.tolist() == center


def test_a_centre_of_mass_is_looked_for_in_the_outline_as_it_is_drawn():
    triangle = {"type": "polygon", "vertices": [[4, 4], [6, 4], [4, 6]]}
    scene = _changed((*CART, "shape"), triangle)
    scene["bodies"][0]["center_of_mass"] = [4.9, 4.9]
    assert scene_spec_from_dict(scene).bodies[0].shift.tolist() == [4.9, 4.9]
    scene["bodies"][0]["center_of_mass"] = [5.1, 5.1]
    with pytest.raises(ValueError, match=r"center_of_mass: expected a point of the"):
        scene_spec_from_dict(scene)


def test_a_circle_off_its_centre_of_mass_is_refused():
    circle = {"type": "circle", "radius": 0.3}
    scene = _changed((*CART, "shape"), circle)
    scene["bodies"][0]["center_of_mass"] = [0.1, 0]
    with pytest.raises(ValueError, match=r"center_of_mass: expected \[0, 0\]"):
        scene_spec_from_dict(scene)


def test_a_scene_that_is_no_object_is_refused(tmp_path: Path):
    path = tmp_path / "room.json"
    path.write_text("[1, 2]")
    with pytest.raises(ValueError, match=r"room\.json: expected an object"):
        load_scene(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "expected JSON"),
        (b'{"x":' + b"[" * 900 + b"]" * 900 + b"}", "nested too deep"),
        (json.dumps(_scene()).encode()[:-40], "expected JSON, .* cut short"),
        (b"\x80\x81", "expected JSON"),
        (b'{"dt": NaN}', "NaN is not a finite number"),
        (b'{"dt": 1, "dt": 2}', "field 'dt' stands twice"),
        (b"[" * 100_000, "nested too deep"),
        (b" " * (MAX_SCENE_BYTES + 1), f"at most {MAX_SCENE_BYTES} bytes"),
    ],
    ids=["empty", "nested", "truncated", "binary", "nan", "repeated", "deep", "large"],
)
def test_what_is_no_scene_file_is_refused(tmp_path: Path, content: bytes, message: str):
    path = tmp_path / "room.json"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        load_scene(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity"])
def test_what_json_does_not_have_is_refused_where_it_stands(
    tmp_path: Path, number: str
):
    path = tmp_path / "room.json"
    scene = _scene()
    name = scene["bodies"][0]["name"]
    scene["bodies"][0]["density"] = "HERE"
    path.write_text(json.dumps(scene).replace('"HERE"', number))
    with pytest.raises(ValueError, match="is not a finite number") as caught:
        load_scene(path)
    where = f"{path}: bodies: {name!r}: density: {number} is not a finite number"
    assert str(caught.value) == where


def test_a_number_too_large_for_a_float_is_refused(tmp_path: Path):
    path = tmp_path / "room.json"
    path.write_text(json.dumps(_scene()).replace('"dt": 0.02', '"dt": 1e999'))
    with pytest.raises(ValueError, match=r"dt: expected a finite .* got inf"):
        load_scene(path)


def test_a_missing_file_is_an_os_error(tmp_path: Path):
    with pytest.raises(FileNotFoundError):
        load_scene(tmp_path / "room.json")


def test_a_saved_scene_is_read_again(tmp_path: Path):
    spec = scene_spec_from_dict(_scene())
    save_scene(spec, tmp_path / "room.json")
    again = load_scene(tmp_path / "room.json")
    assert again.to_dict() == spec.to_dict()
    assert list(tmp_path.iterdir()) == [tmp_path / "room.json"]
