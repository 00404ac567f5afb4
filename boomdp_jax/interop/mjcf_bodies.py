"""Bodies of a MuJoCo document as entries of a scene file: outline, mass, contact."""

import math

import numpy as np
from jaxtyping import Float

from boomdp_jax.interop.mjcf_document import Document
from boomdp_jax.interop.mjcf_elements import restitution_of, turned
from boomdp_jax.physics.shapes import box_outline, circle_moments, polygon_moments

PLANE_HALF_LENGTH, PLANE_HALF_DEPTH = 50.0, 0.5
"""Of the box that stands for an infinite plane [m]."""


def read_bodies(
    document: Document, inertia_tolerance: float
) -> tuple[list[dict], dict[int, str]]:
    """Read everything that has an outline.

    Fills `document.planar`.

    Args:
        document: the world.
        inertia_tolerance: largest relative difference of an inertia from that of the
            outline.

    Returns:
        Entries of `bodies`, and to which of them a geom belongs.

    Raises:
        ValueError: which element is outside the subset, and how.
    """
    model = document.model
    touching = _touching_geoms(document)
    entries, owners = [], {}
    for body in range(model.nbody):
        first = int(model.body_geomadr[body])
        geoms = list(range(first, first + int(model.body_geomnum[body])))
        solid = [geom for geom in geoms if geom in touching]
        if model.body_mocapid[body] >= 0:
            document.refuse("body", body, "no motion capture", "some")
        if document.is_static(body):
            document.theta[body] = document.rest[body]
            for geom in solid if touching else geoms:
                entry = _static(document, body, geom, len(geoms), bool(touching))
                if entry is not None:
                    entries.append(entry)
                    owners[geom] = entry["name"]
            continue
        got = str(len(geoms))
        if len(geoms) > 1:
            geoms, got = solid, f"{got} of which {len(solid)} can touch others"
        if len(geoms) != 1:
            document.refuse("body", body, "one geom for its outline", got)
        entry = _moving(document, body, geoms[0], inertia_tolerance)
        entries.append(entry)
        owners[geoms[0]] = entry["name"]
    for geom, name in owners.items():
        entry = next(each for each in entries if each["name"] == name)
        if geom in touching:
            entry["contact"] = {
                "friction": _friction(document, geom),
                "restitution": restitution_of(model.geom_solref[geom]),
            }
    return entries, owners


def touching_pairs(document: Document) -> dict[tuple[int, int], int]:
    """Pairs of geoms that MuJoCo lets collide.

    Args:
        document: the world.

    Returns:
        For each pair in order the number of its element `pair`, or -1.
    """
    model = document.model
    if document.is_off("contact"):
        return {}
    has_filter = not document.is_off("filterparent")
    excluded = set(model.exclude_signature.tolist())
    found = {}
    for j in range(model.ngeom):
        for i in range(j):
            one, other = (int(model.geom_bodyid[g]) for g in (i, j))
            if model.body_weldid[one] == model.body_weldid[other]:
                continue
            is_on = (model.geom_contype[i] & model.geom_conaffinity[j]) or (
                model.geom_contype[j] & model.geom_conaffinity[i]
            )
            low, high = sorted((one, other))
            is_out = (low << 16) + high in excluded
            if has_filter and _is_child(model, one, other):
                is_out = True
            if is_on and not is_out:
                found[i, j] = -1
    for pair in range(model.npair):
        i, j = sorted((int(model.pair_geom1[pair]), int(model.pair_geom2[pair])))
        found[i, j] = pair
    return found


def _is_child(model, one: int, other: int) -> bool:
    """Whether one of two moving bodies hangs on the other; they do not collide."""
    one, other = int(model.body_weldid[one]), int(model.body_weldid[other])
    up = int(model.body_weldid[model.body_parentid[one]])
    down = int(model.body_weldid[model.body_parentid[other]])
    return bool(one and other and (up == other or down == one))


def _touching_geoms(document: Document) -> set[int]:
    return {geom for pair in touching_pairs(document) for geom in pair}


def _friction(document: Document, geom: int) -> float:
    """Coefficient of a geom; none where contacts have a normal force alone."""
    model = document.model
    if model.geom_condim[geom] == 1:
        return 0.0
    return float(model.geom_friction[geom, 0])


def _static(
    document: Document, body: int, geom: int, num_geoms: int, has_contact: bool
) -> dict | None:
    """A geom that stands still; None for a floor to look at."""
    model, data = document.model, document.data
    kinds = document.mujoco.mjtGeom
    name = document.name("geom", geom)
    if body and num_geoms == 1:
        name = document.name("body", body)
    if model.geom_type[geom] == kinds.mjGEOM_PLANE.value:
        normal = data.geom_xmat[geom].reshape(3, 3)[:, 2]
        if abs(normal[2]) > 1e-6:
            if not has_contact:
                return None
            document.refuse(
                "geom", geom, "a plane that stands upright", normal.tolist()
            )
        angle = math.atan2(normal[1], normal[0]) - 0.5 * math.pi
        sizes = model.geom_size[geom]
        is_along = abs(data.geom_xmat[geom][6]) < 0.5
        half = float(sizes[0 if is_along else 1]) or PLANE_HALF_LENGTH
        place = data.geom_xpos[geom] - PLANE_HALF_DEPTH * normal
        shape = {"type": "box", "half_extents": [half, PLANE_HALF_DEPTH]}
        pose = [*place[:2].tolist(), angle]
        return {"name": name, "shape": shape, "pose": pose, "static": True}
    angle = document.check_level("body", body, data.xmat[body])
    shape, origin, moments = _outline(document, body, geom)
    center = np.zeros(2) if shape["type"] != "polygon" else moments.centroid
    if body:
        document.planar[body] = name, origin
    place = data.xpos[body][:2] + turned(origin + center, angle)
    entry = {"name": name, "shape": shape, "pose": [*place.tolist(), angle]}
    if shape["type"] == "polygon":
        entry["center_of_mass"] = center.tolist()
    return entry | {"static": True}


def _moving(document: Document, body: int, geom: int, tolerance: float) -> dict:
    """A body with joints somewhere above it."""
    model, data, mujoco = document.model, document.data, document.mujoco
    document.check_level("body", body, data.xmat[body])
    if model.body_gravcomp[body]:
        document.refuse("body", body, "gravcomp 0", model.body_gravcomp[body])
    document.theta[body] = _start_angle(document, body)
    shape, origin, moments = _outline(document, body, geom)
    name = document.name("body", body)
    document.planar[body] = name, origin
    mass = float(model.body_mass[body])
    frame = np.zeros(9)
    mujoco.mju_quat2Mat(frame, model.body_iquat[body])
    axis = frame.reshape(3, 3)[2]
    inertia = float(np.sum(axis**2 * model.body_inertia[body]))
    uniform = mass * moments.gyration
    if abs(inertia - uniform) > tolerance * uniform:
        document.refuse(
            "body",
            body,
            f"the inertia of its outline, {uniform:.6g} kg m², about z",
            f"{inertia:.6g} (see inertia_tolerance)",
        )
    velocity = np.zeros(6)
    kind = mujoco.mjtObj.mjOBJ_BODY.value
    mujoco.mj_objectVelocity(model, data, kind, body, velocity, 0)
    entry = {
        "name": name,
        "shape": shape,
        "pose": [*data.xipos[body][:2].tolist(), float(document.theta[body])],
        "twist": velocity[[3, 4, 2]].tolist(),
        "density": mass / moments.area,
    }
    center = model.body_ipos[body][:2] - origin
    if shape["type"] == "polygon" or np.max(np.abs(center)) > 1e-12:
        if shape["type"] == "circle":
            document.refuse(
                "body",
                body,
                "the centre of mass in that of its circle",
                center.tolist(),
            )
        entry["center_of_mass"] = center.tolist()
    return entry


def _start_angle(document: Document, body: int) -> float:
    """Heading with the whole turns that hinges above have made."""
    model, data = document.model, document.data
    parent = int(model.body_parentid[body])
    more = 0.0
    first = int(model.body_jntadr[body])
    for joint in range(first, first + int(model.body_jntnum[body])):
        if model.jnt_type[joint] == document.mujoco.mjtJoint.mjJNT_HINGE.value:
            at = int(model.jnt_qposadr[joint])
            sign = float(np.sign(data.xaxis[joint][2]))
            more += sign * float(data.qpos[at] - model.qpos0[at])
    base = document.rest[body] - document.rest[parent]
    exact = document.theta[parent] + math.atan2(math.sin(base), math.cos(base)) + more
    return float(exact)


def _outline(document: Document, body: int, geom: int):
    """Shape entry, origin of its frame in MuJoCo's body frame, and moments."""
    model, kinds = document.model, document.mujoco.mjtGeom
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    place = model.geom_pos[geom]
    frame = np.zeros(9)
    document.mujoco.mju_quat2Mat(frame, model.geom_quat[geom])
    frame = frame.reshape(3, 3)
    if kind == kinds.mjGEOM_SPHERE.value:
        shape = {"type": "circle", "radius": float(size[0])}
        return shape, place[:2].copy(), circle_moments(float(size[0]))
    if kind == kinds.mjGEOM_CYLINDER.value:
        if abs(abs(frame[2, 2]) - 1.0) > 1e-6:
            document.refuse("geom", geom, "a cylinder along z", frame[:, 2].tolist())
        shape = {"type": "circle", "radius": float(size[0])}
        return shape, place[:2].copy(), circle_moments(float(size[0]))
    if kind == kinds.mjGEOM_BOX.value:
        corners = np.array(
            [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
        )
        points = corners * size
        if np.max(np.abs(frame - np.eye(3))) < 1e-12:
            half = size[:2]
            shape = {"type": "box", "half_extents": half.tolist()}
            return shape, place[:2].copy(), polygon_moments(box_outline(half))
    elif kind == kinds.mjGEOM_MESH.value:
        mesh = int(model.geom_dataid[geom])
        first = int(model.mesh_vertadr[mesh])
        points = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])]
    else:
        name = kinds(kind).name.removeprefix("mjGEOM_").lower()
        document.refuse("geom", geom, "a box, sphere, cylinder or mesh", name)
    points = points.astype(float) @ frame.T + place
    outline = _prism(document, geom, points)
    shape = {"type": "polygon", "vertices": outline.tolist()}
    return shape, np.zeros(2), polygon_moments(outline)


def _prism(
    document: Document, geom: int, points: Float[np.ndarray, "point 3"]
) -> Float[np.ndarray, "vertex 2"]:
    """The outline of an upright prism, counter-clockwise."""
    height = points[:, 2]
    reach = float(np.max(np.ptp(points, axis=0)))
    middle = 0.5 * (height.min() + height.max())
    ends = [hull(points[is_in, :2]) for is_in in (height < middle, height > middle)]
    is_flat = np.minimum(height - height.min(), height.max() - height) < 1e-5 * reach
    same = len(ends[0]) == len(ends[1]) and np.allclose(
        *ends, atol=1e-5 * reach, rtol=0.0
    )
    if not (np.all(is_flat) and same):
        document.refuse("geom", geom, "an upright prism", f"{len(points)} other points")
    return ends[1]


def hull(points: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "vertex 2"]:
    """Convex hull by Andrew's monotone chain, without corners on straight edges.

    Args:
        points: in the plane [m].

    Returns:
        Corners, counter-clockwise, from the leftmost one [m].
    """
    scale = float(np.max(np.ptp(points, axis=0)))
    if scale == 0.0:
        return points[:1]
    rounded = np.round(points / scale, 5)
    order = np.lexsort((rounded[:, 1], rounded[:, 0]))
    chains = []
    for sequence in (order, order[::-1]):
        chain: list[np.ndarray] = []
        for point in points[sequence]:
            while len(chain) > 1:
                u, v = chain[-1] - chain[-2], point - chain[-1]
                if u[0] * v[1] - u[1] * v[0] > 1e-6 * scale * scale:
                    break
                chain.pop()
            chain.append(point)
        chains += chain[:-1]
    return np.array(chains)
