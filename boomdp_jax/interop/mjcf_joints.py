"""Joints and brakes of a MuJoCo document as constraints of a scene."""

import math

import numpy as np

from boomdp_jax.interop.mjcf_document import Document, wrapped
from boomdp_jax.interop.mjcf_elements import FAR
from boomdp_jax.interop.mjcf_softness import check_hard
from boomdp_jax.physics.friction import KNEE_SPEED

_FREE = ("slide", "slide", "hinge")
_DRIVE_FIELDS = {
    "hinge": ("motor_speed", "motor_torque"),
    "slide": ("motor_speed", "motor_force"),
}


def check_joint_kinds(document: Document) -> None:
    """Refuse joints that leave the plane, of which all else would only be a symptom.

    Args:
        document: the world.

    Raises:
        ValueError: a joint is neither a hinge nor a slide.
    """
    for joint in range(document.model.njnt):
        kind = _kind(document, joint)
        if kind not in ("hinge", "slide"):
            document.refuse("joint", joint, "a hinge or a slide", kind)


def read_joints(document: Document) -> list[dict]:
    """What holds each body: a pin, a drawer, a weld, or nothing.

    Args:
        document: with its planar bodies.

    Returns:
        Entries of `constraints`.

    Raises:
        ValueError: which element is outside the subset, and how.
    """
    model = document.model
    entries = []
    for body in range(1, model.nbody):
        if document.is_static(body):
            continue
        first = int(model.body_jntadr[body])
        joints = [first + i for i in range(int(model.body_jntnum[body]))]
        kinds = [_kind(document, joint) for joint in joints]
        for joint in joints:
            _check_joint(document, joint)
        if kinds == ["hinge"]:
            entries.append(_pin(document, body, joints[0]))
        elif kinds == ["slide"]:
            entries.append(_drawer(document, body, joints[0]))
        elif not kinds:
            entries.append(_weld(document, body))
        elif tuple(sorted(kinds, reverse=True)) == _FREE:
            _check_free(document, body, joints)
        else:
            expected = "no joint, one hinge, one slide, or two slides and a hinge"
            document.refuse("body", body, expected, " ".join(kinds))
    return entries


def _kind(document: Document, joint: int) -> str:
    kinds = document.mujoco.mjtJoint
    name = kinds(int(document.model.jnt_type[joint])).name
    return name.removeprefix("mjJNT_").lower()


def _check_joint(document: Document, joint: int) -> None:
    """Planar, and without what the engine lacks."""
    model, data = document.model, document.data
    kind = _kind(document, joint)
    if kind == "hinge" and abs(abs(data.xaxis[joint][2]) - 1.0) > 1e-6:
        axis = np.round(data.xaxis[joint], 6).tolist()
        document.refuse("joint", joint, "an axis along z", axis)
    if kind == "slide":
        document.direction("joint", joint, data.xaxis[joint])
    dof = int(model.jnt_dofadr[joint])
    stiffness = [model.jnt_stiffness[joint]]
    if hasattr(model, "jnt_stiffnesspoly"):
        stiffness += model.jnt_stiffnesspoly[joint].tolist()
    bent = [number for number in stiffness if number and not document.is_off("spring")]
    for field, value in (
        ("stiffness", bent[0] if bent else 0.0),
        ("armature", model.dof_armature[dof]),
        ("gravity compensation", model.jnt_actgravcomp[joint]),
        ("force limit", model.jnt_actfrclimited[joint]),
    ):
        if np.any(value != 0):
            document.refuse("joint", joint, f"no {field}", value)


def _check_free(document: Document, body: int, joints: list[int]) -> None:
    """Nothing acts in the joints of a body that is free in the plane."""
    data = document.data
    slides = [j for j in joints if _kind(document, j) == "slide"]
    one, other = (data.xaxis[joint] for joint in slides)
    if abs(one[0] * other[1] - one[1] * other[0]) < 1e-6:
        document.refuse("body", body, "slides along two directions", one.tolist())
    for joint in joints:
        damping, loss, is_limited = _passive(document, joint)
        for field, value in (
            ("damping", damping),
            ("frictionloss", loss),
            ("range", is_limited),
        ):
            if value:
                expected = f"no {field} in a body that is free in the plane"
                document.refuse("joint", joint, expected, value)


def _passive(document: Document, joint: int) -> tuple[float, float, bool]:
    """Damping, friction and whether there is a range, of what is not disabled."""
    model = document.model
    dof = int(model.jnt_dofadr[joint])
    damping, loss = float(model.dof_damping[dof]), float(model.dof_frictionloss[dof])
    if document.is_off("damper"):
        damping = 0.0
    elif np.any(getattr(model, "dof_dampingpoly", np.zeros((dof + 1, 1)))[dof]):
        document.refuse("joint", joint, "linear damping", model.dof_dampingpoly[dof])
    is_limited = bool(model.jnt_limited[joint]) and not document.is_off("limit")
    return damping, 0.0 if document.is_off("frictionloss") else loss, is_limited


def _pin(document: Document, body: int, joint: int) -> dict:
    """A revolute joint; `a` is the body that turns forwards with the coordinate."""
    model, data = document.model, document.data
    a, b = body, int(model.body_parentid[body])
    sign = float(np.sign(data.xaxis[joint][2]))
    if sign < 0 and b in document.planar:
        a, b, sign = b, a, 1.0
    entry = _ends(document, "revolute", a, b, data.xanchor[joint])
    rest = wrapped(document.rest_angle(a) - document.rest_angle(b))
    zero = rest - sign * float(model.qpos0[model.jnt_qposadr[joint]])
    return entry | _laws(document, joint, sign, zero)


def _drawer(document: Document, body: int, joint: int) -> dict:
    """A prismatic joint of a body against its parent."""
    model, data = document.model, document.data
    parent = int(model.body_parentid[body])
    at = int(model.jnt_qposadr[joint])
    slide = float(data.qpos[at])
    axis = data.xaxis[joint]
    # MuJoCo reports it as it is before the slide.
    anchor = data.xanchor[joint]
    entry = {
        "type": "prismatic",
        "a": document.partner(body),
        "b": document.partner(parent),
        "anchor_a": document.local(body, anchor + slide * axis).tolist(),
        "anchor_b": document.local(parent, anchor).tolist(),
        "axis": wrapped(
            document.direction("joint", joint, axis) - document.angle(parent)
        ),
        "angle": document.angle(body) - document.angle(parent),
    }
    return entry | _laws(document, joint, 1.0, 0.0)


def _weld(document: Document, body: int) -> dict:
    parent = int(document.model.body_parentid[body])
    entry = _ends(document, "weld", body, parent, document.data.xpos[body])
    return entry | {"angle": document.angle(body) - document.angle(parent)}


def _ends(document: Document, kind: str, a: int, b: int, anchor: np.ndarray) -> dict:
    return {
        "type": kind,
        "a": document.partner(a),
        "b": document.partner(b),
        "anchor_a": document.local(a, anchor).tolist(),
        "anchor_b": document.local(b, anchor).tolist(),
    }


def _laws(document: Document, joint: int, sign: float, zero: float) -> dict:
    """Friction, range and motor of a joint whose coordinate is sign * (x - zero)."""
    model = document.model
    dof = int(model.jnt_dofadr[joint])
    damping, loss, is_limited = _passive(document, joint)
    if loss:
        solref, solimp = model.dof_solref[dof], model.dof_solimp[dof]
        check_hard(document, "joint", joint, "friction", solref, solimp)
    laws = [{"viscous": damping}] if damping else []
    laws += [{"dry": loss}] if loss else []
    motors: list[dict] = []
    for actuator in range(model.nu):
        kinds = document.mujoco.mjtTrn
        if (
            model.actuator_trntype[actuator] != kinds.mjTRN_JOINT.value
            or model.actuator_trnid[actuator, 0] != joint
        ):
            continue
        law = velocity_law(document, actuator)
        if law is None:
            continue
        viscous, limit, force = law
        gear = float(model.actuator_gear[actuator, 0])
        viscous, limit, force = viscous * gear**2, limit * abs(gear), force * gear
        if force or (laws and math.isfinite(limit)):
            fields = _DRIVE_FIELDS[_kind(document, joint)]
            if not math.isclose(viscous, limit / KNEE_SPEED, rel_tol=1e-6):
                expected = f"a gain of the force limit over {KNEE_SPEED}, as of a motor"
                document.refuse("actuator", actuator, expected, viscous)
            speed = sign * force / viscous
            motors.append(dict(zip(fields, (speed, limit), strict=True)))
        else:
            dry = {"dry": limit} if math.isfinite(limit) else {}
            laws.append({"viscous": viscous} | dry)
    for what, several in (("friction", laws), ("motor", motors)):
        if len(several) > 1:
            document.refuse("joint", joint, f"one law of {what}", several)
    entry: dict = {}
    for law in laws + motors:
        entry |= law
    if is_limited:
        # Ends take hold where their margin begins.
        margin = float(model.jnt_margin[joint]) * np.array([1.0, -1.0])
        ends = sorted(sign * (model.jnt_range[joint] + margin) + zero)
        near = [abs(end) < FAR * (1.0 - 1e-6) for end in ends]
        names = ("lower", "upper")
        entry |= {
            name: float(end)
            for name, end, is_near in zip(names, ends, near, strict=True)
            if is_near
        }
        if any(near):
            solref, solimp = model.jnt_solref[joint], model.jnt_solimp[joint]
            args = (document, "joint", joint, "limit", solref, solimp)
            check_hard(*args, is_stop=True)
    return entry


def velocity_law(
    document: Document, actuator: int
) -> tuple[float, float, float] | None:
    """What an actuator does whatever its control, if it does anything.

    Args:
        document: the world.
        actuator: its number.

    Returns:
        Force per speed, limit, force at rest; None for a force that follows a control
        alone, which is no part of a scene, and for what the document disables.

    Raises:
        ValueError: it is a servo, adds to the inertia or damping of what it drives, or
            has to push without a control.
    """
    model, mujoco = document.model, document.mujoco
    for field in ("armature", "damping", "dampingpoly"):
        added = getattr(model, f"actuator_{field}", np.zeros(model.nu))[actuator]
        is_gone = field != "armature" and document.is_off("damper")
        if np.any(added) and not is_gone:
            document.refuse("actuator", actuator, f"no {field}", added)
    group = int(model.actuator_group[actuator])
    is_off = 0 <= group <= 30 and model.opt.disableactuator & 1 << group
    if is_off or document.is_off("actuation"):
        return None
    bias = int(model.actuator_biastype[actuator])
    if bias == mujoco.mjtBias.mjBIAS_NONE.value:
        low, high = (float(n) for n in model.actuator_ctrlrange[actuator])
        is_clamped = model.actuator_ctrllimited[actuator]
        if is_clamped and not low <= 0.0 <= high and not document.is_off("clampctrl"):
            document.refuse("actuator", actuator, "a ctrlrange about 0", (low, high))
        return None
    constant, place, speed = (float(n) for n in model.actuator_biasprm[actuator, :3])
    is_free = not np.any(model.actuator_gainprm[actuator])
    if bias != mujoco.mjtBias.mjBIAS_AFFINE.value or place or speed > 0 or not is_free:
        expected = "a direct force, or gain 0 and a bias that falls with speed"
        document.refuse("actuator", actuator, expected, "another")
    limit = math.inf
    if model.actuator_forcelimited[actuator]:
        low, high = (float(n) for n in model.actuator_forcerange[actuator])
        if not math.isclose(-low, high, rel_tol=1e-9):
            document.refuse(
                "actuator", actuator, "a symmetric force range", (low, high)
            )
        limit = high
    return -speed, limit, constant
