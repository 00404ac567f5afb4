"""Equalities, wheels and feet of a MuJoCo document as constraints of a scene."""

import math

import numpy as np

from boomdp_jax.interop.mjcf_document import Document, wrapped
from boomdp_jax.interop.mjcf_elements import FOOT_ANGLES, FOOT_LIMIT, FOOT_VISCOUS
from boomdp_jax.interop.mjcf_joints import velocity_law
from boomdp_jax.interop.mjcf_softness import check_hard
from boomdp_jax.physics.shapes import foot_loads

_UNLIMITED = 1e12
"""Limit of the one direction of a wheel that has none, beside one that has [N]."""


def read_equalities(document: Document) -> list[dict]:
    """Pins, welds and rods that are equality constraints.

    Args:
        document: with its planar bodies.

    Returns:
        Entries of `constraints`.

    Raises:
        ValueError: which element is outside the subset, and how.
    """
    model, mujoco = document.model, document.mujoco
    kinds = mujoco.mjtEq
    entries = []
    for index in range(model.neq):
        kind = int(model.eq_type[index])
        if not model.eq_active0[index] or document.is_off("equality"):
            continue
        if kind == kinds.mjEQ_TENDON.value:
            entries.append(_rod(document, index))
        elif kind in (kinds.mjEQ_CONNECT.value, kinds.mjEQ_WELD.value):
            is_weld = kind == kinds.mjEQ_WELD.value
            entries.append(_tie(document, index, is_weld))
        else:
            name = kinds(kind).name.removeprefix("mjEQ_").lower()
            document.refuse("equality", index, "connect, weld or one tendon", name)
        solref, solimp = model.eq_solref[index], model.eq_solimp[index]
        check_hard(document, "equality", index, "", solref, solimp)
    return entries


def _tie(document: Document, index: int, is_weld: bool) -> dict:
    """A pin or a weld, between bodies or sites."""
    model, mujoco = document.model, document.mujoco
    numbers = model.eq_data[index]
    if is_weld and numbers[10] <= 0.0:
        document.refuse("equality", index, "a torquescale above 0", numbers[10])
    ids = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
    if model.eq_objtype[index] == mujoco.mjtObj.mjOBJ_SITE.value:
        a, b = (int(model.site_bodyid[site]) for site in ids)
        anchors = [model.site_pos[site] for site in ids]
        frames = [_turn(document, model.site_quat[site]) for site in ids]
        turn = frames[1] - frames[0]
    else:
        a, b = ids
        anchors, turn = [numbers[:3], numbers[3:6]], 0.0
        if is_weld:
            # Its numbers begin with the second body's point.
            anchors = [numbers[3:6], numbers[:3]]
            turn = -_turn(document, numbers[6:10])
    if a not in document.planar or document.is_static(a):
        a, b, anchors, turn = b, a, anchors[::-1], -turn
    if document.is_static(a):
        document.refuse("equality", index, "a body that can move", "none")
    # Headings of what stands for the bodies may differ from those of MuJoCo's bodies.
    entry = {
        "type": "weld" if is_weld else "revolute",
        "a": document.partner(a),
        "b": document.partner(b),
        "anchor_a": document.attached(a, anchors[0]).tolist(),
        "anchor_b": document.attached(b, anchors[1]).tolist(),
    }
    if is_weld:
        fixed = 0.0 if b in document.planar else float(document.rest[b])
        entry["angle"] = wrapped(turn + fixed)
    return entry


def _turn(document: Document, quaternion: np.ndarray) -> float:
    matrix = np.zeros(9)
    document.mujoco.mju_quat2Mat(matrix, quaternion)
    return float(np.arctan2(matrix[3], matrix[0]))


def _rod(document: Document, index: int) -> dict:
    """A tendon of constant length between two sites."""
    model, mujoco = document.model, document.mujoco
    tendon = int(model.eq_obj1id[index])
    first, num = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
    kinds = model.wrap_type[first : first + num].tolist()
    if model.eq_obj2id[index] >= 0 or kinds != [mujoco.mjtWrap.mjWRAP_SITE.value] * 2:
        document.refuse("equality", index, "one tendon between two sites", kinds)
    sites = model.wrap_objid[first : first + 2].tolist()
    length = float(model.tendon_length0[tendon] + model.eq_data[index, 0])
    if document.is_static(int(model.site_bodyid[sites[0]])):
        sites = sites[::-1]
    a, b = (int(model.site_bodyid[site]) for site in sites)
    return {
        "type": "distance",
        "a": document.partner(a),
        "b": document.partner(b),
        "anchor_a": document.attached(a, model.site_pos[sites[0]]).tolist(),
        "anchor_b": document.attached(b, model.site_pos[sites[1]]).tolist(),
        "length": length,
    }


def read_floor(
    document: Document, bodies: list[dict], normal_gravity: float
) -> list[dict]:
    """Wheels and feet: forces on sites against their own velocity.

    A body with feet gets them as its field `feet`.

    Args:
        document: with its planar bodies.
        bodies: entries of `bodies`.
        normal_gravity: load on the floor [m/s²].

    Returns:
        Entries of `constraints`.

    Raises:
        ValueError: which element is outside the subset, and how.
    """
    model, kinds = document.model, document.mujoco.mjtTrn
    sites: dict[int, list[int]] = {}
    for actuator in range(model.nu):
        law = velocity_law(document, actuator)
        kind = int(model.actuator_trntype[actuator])
        if law is None or kind == kinds.mjTRN_JOINT.value:
            continue
        site, reference = model.actuator_trnid[actuator].tolist()
        gear = model.actuator_gear[actuator]
        is_site = kind == kinds.mjTRN_SITE.value and reference < 0
        if not is_site or law[2] or np.any(gear[2:]) or not np.any(gear[:2]):
            expected = "brakes of joints, or along the plane of sites"
            document.refuse("actuator", actuator, expected, "another")
        sites.setdefault(site, []).append(actuator)
    entries = []
    feet: dict[int, list[tuple[np.ndarray, float, float]]] = {}
    for site, actuators in sites.items():
        body = int(model.site_bodyid[site])
        if document.is_static(body):
            document.refuse("site", site, "a body that can move", "none")
        place = document.attached(body, model.site_pos[site])
        heading = document.check_level("site", site, document.data.site_xmat[site])
        heading -= document.angle(body)
        laws = [_planar_law(document, actuator) for actuator in actuators]
        if len(laws) == len(FOOT_ANGLES):
            _, viscous, limit = laws[0]
            angles = np.array([law[0] - laws[0][0] for law in laws])
            is_even = np.allclose(angles, FOOT_ANGLES)
            if not (is_even and np.allclose([law[1:] for law in laws], laws[0][1:])):
                expected = "equal forces along four directions 45° apart"
                document.refuse("site", site, expected, angles.tolist())
            own = place, viscous / FOOT_VISCOUS, limit / FOOT_LIMIT
            feet.setdefault(body, []).append(own)
        else:
            entries.append(_wheel(document, site, laws, place, heading))
    for body, own in feet.items():
        name = document.partner(body)
        entry = next(each for each in bodies if each["name"] == name)
        entries.append(_ground(document, body, entry, own, normal_gravity))
    return entries


def _planar_law(document: Document, actuator: int) -> tuple[float, float, float]:
    """Direction in the site's frame, force per speed along it, limit."""
    law = velocity_law(document, actuator)
    assert law is not None
    gear = document.model.actuator_gear[actuator][:2]
    size = float(np.hypot(*gear))
    direction = float(np.arctan2(gear[1], gear[0]))
    return direction, law[0] * size**2, law[1] * size


def _wheel(
    document: Document,
    site: int,
    laws: list[tuple[float, float, float]],
    place: np.ndarray,
    heading: float,
) -> dict:
    """One direction, or two at a right angle."""
    body = int(document.model.site_bodyid[site])
    axes = [law[0] for law in laws]
    if len(laws) > 2 or (len(laws) == 2 and abs(math.cos(axes[1] - axes[0])) > 1e-9):
        expected = "one force, two at a right angle, or four 45° apart"
        document.refuse("site", site, expected, np.round(axes, 6).tolist())
    viscous, limits = [law[1] for law in laws], [law[2] for law in laws]
    is_lateral = len(laws) == 1 and abs(math.cos(axes[0])) < 1e-9
    if len(laws) == 1:
        viscous.append(0.0)
        limits.append(0.0 if math.isfinite(limits[0]) else math.inf)
    if is_lateral:
        # The second axis of the site: a wheel that rolls freely.
        viscous, limits, axes = viscous[::-1], limits[::-1], [0.0]
    entry = {
        "type": "wheel",
        "a": document.partner(body),
        "pose": [*place.tolist(), wrapped(heading + axes[0])],
        "viscous": viscous,
    }
    if any(math.isfinite(limit) for limit in limits):
        entry["dry"] = [min(limit, _UNLIMITED) for limit in limits]
    return entry


def _ground(
    document: Document,
    body: int,
    entry: dict,
    feet: list[tuple[np.ndarray, float, float]],
    normal_gravity: float,
) -> dict:
    """Feet that share a load as statics has it."""
    places = np.array([place for place, _, _ in feet])
    viscous, limit = (np.array([foot[i] for foot in feet]) for i in (1, 2))
    centers = document.model.body_ipos[body]
    loads = foot_loads(places - document.attached(body, centers))
    shares = [viscous / viscous.sum()]
    if np.all(np.isfinite(limit)):
        shares.append(limit / limit.sum())
    if not all(np.allclose(share, loads, atol=1e-6) for share in shares):
        expected = f"feet that share the load as {np.round(loads, 6).tolist()}"
        document.refuse("body", body, expected, np.round(shares[-1], 6).tolist())
    entry["feet"] = places.tolist()
    ground = {"type": "ground", "a": entry["name"], "viscous": float(viscous.sum())}
    if np.all(np.isfinite(limit)):
        weight = float(document.model.body_mass[body]) * normal_gravity
        if weight <= 0.0:
            document.refuse("body", body, "gravity towards its floor", normal_gravity)
        ground["dry"] = float(limit.sum()) / weight
    return ground
