"""The planar part of MuJoCo's language, read from any document into a scene."""

import math
import os
from typing import Any

import numpy as np

from boomdp_jax.interop.mjcf_bodies import read_bodies, touching_pairs
from boomdp_jax.interop.mjcf_document import Document
from boomdp_jax.interop.mjcf_elements import SOFT_STEPS, restitution_of
from boomdp_jax.interop.mjcf_joints import check_joint_kinds, read_joints
from boomdp_jax.interop.mjcf_softness import check_hard
from boomdp_jax.interop.mjcf_ties import read_equalities, read_floor
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict

_MOST_MARGIN = 1e-2
"""By how much surfaces may stand out from their outlines [m]."""


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
    sensors, cameras, lights, direct drives; and what the document itself disables, by
    flags of `option` and `actuatorgroupdisable`.

    Ends of ranges, equalities, contact and dry friction of joints are taken as hard.
    MuJoCo's own give way a little, and are refused where their `solref` and `solimp`
    make them much softer than its default (a time constant above 0.1 s instead of
    0.02 s), or let ends throw back. Margins up to 1 cm are taken as none.

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
    model = document.model
    where = f"{document.source}: option"
    for field, flag, value in (
        ("density 0", None, model.opt.density),
        ("viscosity 0", None, model.opt.viscosity),
        ("no flex", None, model.nflex),
        ("tendons without stiffness", "spring", _of_tendons(model, "stiffness")),
        ("tendons without damping", "damper", _of_tendons(model, "damping")),
        ("tendons without friction", "frictionloss", model.tendon_frictionloss),
        ("tendons without range", "limit", model.tendon_limited),
        ("tendons without armature", None, _of_tendons(model, "armature")),
    ):
        if np.any(value) and not (flag and document.is_off(flag)):
            raise ValueError(f"{where}: expected {field}, got {np.max(value)}")
    enabled, flags = model.opt.enableflags, document.mujoco.mjtEnableBit
    if enabled & flags.mjENBL_OVERRIDE.value and touching_pairs(document):
        raise ValueError(
            f"{where}: expected no flag override where bodies touch, got it enabled"
        )
    if hasattr(flags, "mjENBL_SLEEP") and enabled & flags.mjENBL_SLEEP.value:
        asleep = document.mujoco.mjtSleepPolicy.mjSLEEP_INIT.value
        if np.any(model.tree_sleep_policy == asleep):
            raise ValueError(
                f"{where}: expected no flag sleep where bodies start asleep, got it "
                "enabled"
            )
    if model.opt.gravity[2] > 0.0:
        raise ValueError(
            f"{where}: expected no gravity upwards, got {model.opt.gravity}"
        )
    if document.is_off("gravity"):
        return np.zeros(3)
    return model.opt.gravity


def _of_tendons(model: Any, field: str) -> np.ndarray:
    """A number of every tendon, and those of higher order that newer MuJoCo has."""
    names = (f"tendon_{field}", f"tendon_{field}poly")
    return np.concatenate([np.ravel(getattr(model, name, ())) for name in names])


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
    if pair >= 0:
        _check_surface(document, "pair", pair)
    else:
        for geom in (i, j):
            _check_surface(document, "geom", geom)


def _check_surface(document: Document, kind: str, index: int) -> None:
    """Contact begins where outlines meet, and is hard."""
    model = document.model
    margin = float(getattr(model, f"{kind}_margin")[index])
    if margin > _MOST_MARGIN:
        document.refuse(kind, index, f"a margin of at most {_MOST_MARGIN}", margin)
    solref = getattr(model, f"{kind}_solref")[index]
    # As two negative numbers they are a restitution.
    if solref[0] > 0.0:
        solimp = getattr(model, f"{kind}_solimp")[index]
        check_hard(document, kind, index, "", solref, solimp, most_steps=SOFT_STEPS)
