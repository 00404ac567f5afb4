"""The planar part of MuJoCo's language, read from any document into a scene."""

import math
import os

import numpy as np

from boomdp_jax.interop.mjcf_bodies import read_bodies, touching_pairs
from boomdp_jax.interop.mjcf_document import Document
from boomdp_jax.interop.mjcf_elements import restitution_of
from boomdp_jax.interop.mjcf_joints import check_joint_kinds, read_joints
from boomdp_jax.interop.mjcf_ties import read_equalities, read_floor
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict


def from_mjcf(
    source: str | os.PathLike, *, inertia_tolerance: float = 1e-6
) -> SceneSpec:
    """Read a planar MuJoCo document, of anybody's, as a scene.

    Bodies move in the x-y plane: by two slides and a hinge along z (free), a hinge
    (pin), a slide (drawer) or no joint (weld to their parent). Each has one geom for
    its outline: a box, a sphere, an upright cylinder or an upright prism as a mesh.
    Read are masses, joint damping or friction loss, ranges, equalities `connect`,
    `weld` and `tendon` between two sites, brakes (`general` actuators without gain) as
    motors, wheels and feet, contact with its friction, gravity, and the start, from a
    key frame `start` if there is one. An upright plane becomes a static box, 1 m thick
    and 100 m long if it is infinite. Left out is what has no effect without control:
    sensors, cameras, lights, direct drives.

    Args:
        source: a path, or the document itself, which begins with "<".
        inertia_tolerance: largest relative difference of an inertia from that of a
            uniform outline of the same mass, which the scene then has; spheres need
            0.2, and boxes that lean on MuJoCo's own inertia none.

    Returns:
        The scene, of which everything is known: `params()` is its hypothesis. Its step
        is the number `scene_dt` in `custom` if there is one, else MuJoCo's. Of a joint
        `a` is the child, unless it is a hinge along -z.

    Raises:
        ValueError: which element is outside the subset, what was expected, what was
            got.
        ImportError: MuJoCo is not installed.
    """
    document = Document(source)
    check_joint_kinds(document)
    gravity = _read_world(document)
    bodies, owners = read_bodies(document, inertia_tolerance)
    normal_gravity = float(max(0.0, -gravity[2]))
    constraints = [
        *read_joints(document),
        *read_equalities(document),
        *read_floor(document, bodies, normal_gravity),
    ]
    _read_touch(document, bodies, owners, constraints)
    content = {
        "schema": "planar-scene-1",
        "gravity": gravity[:2].tolist(),
        "normal_gravity": normal_gravity,
        "dt": _read_step(document),
        "bodies": bodies,
        "constraints": constraints,
    }
    return scene_spec_from_dict(content, document.source)


def _read_world(document: Document) -> np.ndarray:
    """Gravity, and that there is nothing in the world that has no place here."""
    model, flags = document.model, document.mujoco.mjtDisableBit
    where = f"{document.source}: option"
    for field, value in (
        ("density 0", model.opt.density),
        ("viscosity 0", model.opt.viscosity),
        ("no flex", model.nflex),
        ("tendons without stiffness", model.tendon_stiffness),
        ("tendons without damping", model.tendon_damping),
        ("tendons without friction", model.tendon_frictionloss),
        ("tendons without range", model.tendon_limited),
    ):
        if np.any(value):
            raise ValueError(f"{where}: expected {field}, got {np.max(value)}")
    if model.opt.gravity[2] > 0.0:
        raise ValueError(
            f"{where}: expected no gravity upwards, got {model.opt.gravity}"
        )
    if model.opt.disableflags & flags.mjDSBL_GRAVITY.value:
        return np.zeros(3)
    return model.opt.gravity


def _read_step(document: Document) -> float:
    """Length of a step of the scene [s]."""
    model = document.model
    index = document.mujoco.mj_name2id(
        model, document.mujoco.mjtObj.mjOBJ_NUMERIC.value, "scene_dt"
    )
    if index < 0:
        return float(model.opt.timestep)
    return float(model.numeric_data[model.numeric_adr[index]])


def _read_touch(
    document: Document,
    bodies: list[dict],
    owners: dict[int, str],
    constraints: list[dict],
) -> None:
    """Groups of bodies that do not touch each other, in their field `contact`."""
    pairs = touching_pairs(document)
    if not pairs:
        return
    names = [body["name"] for body in bodies]
    static = {body["name"] for body in bodies if body.get("static")}
    joined = {frozenset((c["a"], c["b"])) for c in constraints if "b" in c}
    touching = set()
    for (i, j), pair in pairs.items():
        one, other = owners[i], owners[j]
        if {one, other} <= static:
            continue
        if frozenset((one, other)) in joined:
            expected = "no contact of bodies that are tied"
            document.refuse("geom", i, expected, f"some with {other!r}")
        touching.add(frozenset((one, other)))
        _check_pair(document, i, j, pair)
    group = {name: name for name in names}
    silent = [
        (one, other)
        for j, other in enumerate(names)
        for one in names[:j]
        if not {one, other} <= static
        and frozenset((one, other)) not in touching | joined
    ]
    for one, other in silent:
        old, new = group[other], group[one]
        group = {k: new if v == old else v for k, v in group.items()}
    for pair in touching:
        one, other = sorted(pair)
        if group[one] == group[other]:
            raise ValueError(
                f"{document.source}: contact: expected groups that do not touch "
                f"themselves and touch all others, got {one!r} and {other!r} that touch"
            )
    members = list(group.values())
    for body in bodies:
        if members.count(group[body["name"]]) > 1:
            body["contact"] = body.get("contact", {}) | {"group": group[body["name"]]}


def _check_pair(document: Document, i: int, j: int, pair: int) -> None:
    """Two surfaces together are what the engine makes of each."""
    model = document.model
    dims = model.geom_condim[[i, j]]
    own = np.where(dims == 1, 0.0, model.geom_friction[[i, j], 0])
    bounce = [restitution_of(model.geom_solref[geom]) for geom in (i, j)]
    if pair >= 0:
        friction = float(model.pair_friction[pair, 0])
        friction = 0.0 if model.pair_dim[pair] == 1 else friction
        together = restitution_of(model.pair_solref[pair])
    else:
        friction = float(np.max(model.geom_friction[[i, j], 0]))
        friction = 0.0 if dims.max() == 1 else friction
        together = bounce[0] if math.isclose(*bounce) else math.nan
    for field, ours, theirs in (
        ("friction", math.sqrt(own[0] * own[1]), friction),
        ("restitution", max(bounce), together),
    ):
        if not math.isclose(ours, theirs, rel_tol=1e-6, abs_tol=1e-12):
            expected = f"a {field} with {document.name('geom', j)!r} of {ours:.6g}"
            document.refuse("geom", i, expected, f"{theirs:.6g}")
