"""Bodies are the same if names and outlines are, however the outlines are written."""

import copy

import numpy as np
import pytest

from boomdp_jax.physics.same_bodies import check_same_bodies
from boomdp_jax.physics.scene_spec import scene_spec_from_dict

BOX = {"type": "box", "half_extents": [0.5, 0.3]}
CORNERS = [[-0.5, -0.3], [0.5, -0.3], [0.5, 0.3], [-0.5, 0.3]]
WEDGE = {"type": "polygon", "vertices": [[0, 0], [3, 0], [0, 1.5]]}
DISC = {"type": "circle", "radius": 0.1}


def spec_of(shape, name="box", **fields):
    body = {"name": name, "shape": shape, "density": 1.0, **fields}
    content = {"schema": "planar-scene-1", "dt": 0.02, "bodies": [body]}
    return scene_spec_from_dict(copy.deepcopy(content))


def shifted(shape, by):
    corners = (np.array(shape["vertices"]) + by).tolist()
    return {"type": "polygon", "vertices": corners}


SAME = {
    "rounded": (BOX, {"type": "box", "half_extents": np.float32([0.5, 0.3])}),
    "box as a polygon": (BOX, {"type": "polygon", "vertices": CORNERS}),
    "from another corner": (
        BOX,
        {"type": "polygon", "vertices": CORNERS[2:] + CORNERS[:2]},
    ),
    "drawn elsewhere": (WEDGE, shifted(WEDGE, [5, -2])),
    "disc": (DISC, {"type": "circle", "radius": np.float32(0.1)}),
}


@pytest.mark.parametrize("pair", SAME.values(), ids=SAME)
def test_the_same_outline_is_accepted(pair):
    check_same_bodies(spec_of(pair[0]), spec_of(pair[1]), "post.npz")


DIFFERENT = {
    "size": (
        spec_of(BOX),
        spec_of({"type": "box", "half_extents": [5, 3]}),
        r"'box': shape.half_extents: expected \[5.0, 3.0\], as in scene.json, got "
        r"\[0.5, 0.3\]",
    ),
    "kind": (spec_of(DISC), spec_of(BOX), "'box': shape: expected .*'box'.*'circle'"),
    "radius": (
        spec_of(DISC),
        spec_of({"type": "circle", "radius": 0.2}),
        "'box': shape.radius: expected 0.2, as in scene.json, got 0.1",
    ),
    "corner": (
        spec_of(WEDGE),
        spec_of({"type": "polygon", "vertices": [[0, 0], [3, 0], [0, 1]]}),
        r"'box': shape.vertices\[2\]: expected \[0.0, 1.0\]",
    ),
    "centre": (
        spec_of(BOX, center_of_mass=None),
        spec_of(BOX, center_of_mass=[0.1, 0]),
        r"'box': center_of_mass: expected \[0.1, 0.0\], as in scene.json, got None",
    ),
    "name": (
        spec_of(BOX),
        spec_of(BOX, "crate"),
        "expected bodies crate, as in .* box",
    ),
}


@pytest.mark.parametrize("case", DIFFERENT.values(), ids=DIFFERENT)
def test_another_body_is_refused(case):
    got, wanted, message = case
    with pytest.raises(ValueError, match=f"^post.npz: .*{message}"):
        check_same_bodies(got, wanted, "post.npz", ", as in scene.json")
