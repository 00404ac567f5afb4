"""Wheels, the floor and what acts in joints, as actuators of a MuJoCo document."""

import math
import xml.etree.ElementTree as ET

import numpy as np

from boomdp_jax.interop.mjcf_elements import (
    FAR,
    FOOT_ANGLES,
    FOOT_LIMIT,
    FOOT_VISCOUS,
    along,
    is_coulomb,
    numbers,
    velocity_force,
)
from boomdp_jax.physics.body_spec import BodySpec
from boomdp_jax.physics.friction import KNEE_SPEED
from boomdp_jax.physics.params import Ground, Params, Prismatic, Revolute
from boomdp_jax.physics.scene_spec import SceneSpec


def add_joint_laws(
    joint: ET.Element,
    actuators: ET.Element,
    slots: Revolute | Prismatic,
    slot: int,
    time_step: float,
) -> list[str]:
    """Give a joint its friction, range and motor.

    Args:
        joint: the element, with its name.
        actuators: section of the document.
        slots: joints of its kind, of NumPy arrays.
        slot: which one.
        time_step: MuJoCo's time step [s].

    Returns:
        What is not exactly the engine's law.
    """
    name, notes = joint.attrib["name"], []
    soft = numbers((2.0 * time_step, 1.0))
    viscous, dry = float(slots.viscous[slot]), float(slots.dry[slot])
    if viscous > 0.0 and dry > 0.0:
        if math.isinf(dry):
            joint.set("damping", repr(viscous))
        elif is_coulomb(viscous, dry):
            joint.set("frictionloss", repr(dry))
            joint.set("solreffriction", soft)
            joint.set("solimpfriction", "0.99 0.999 0.001")
            notes.append(f"{name}: dry friction sticks by MuJoCo's solver")
        else:
            law = velocity_force(viscous, dry, name=f"{name}.friction", joint=name)
            ET.SubElement(actuators, "general", law)
    if slots.limit is not None and np.any(np.isfinite(slots.limit[slot])):
        joint.set("limited", "true")
        joint.set("range", numbers(np.clip(slots.limit[slot], -FAR, FAR)))
        # Damped twice over: at its critical value a stop met in mid-step throws back.
        joint.set("solreflimit", numbers((2.0 * time_step, 2.0)))
        notes.append(f"{name}: a range with soft ends")
    if slots.motor is not None and slots.motor[slot, 1] > 0.0:
        speed, strength = (float(number) for number in slots.motor[slot])
        law = velocity_force(
            strength / KNEE_SPEED,
            strength,
            speed=speed,
            name=f"{name}.motor",
            joint=name,
        )
        ET.SubElement(actuators, "general", law)
    return notes


def add_wheel(
    element: ET.Element,
    actuators: ET.Element,
    spec: SceneSpec,
    params: Params,
    body: int,
) -> list[str]:
    """Put a body's wheels on it: sites, and forces along and across them.

    Args:
        element: the body's.
        actuators: section of the document.
        spec: the scene.
        params: the hypothesis, of NumPy arrays.
        body: which one.

    Returns:
        What is not exactly the engine's law.
    """
    wheel, notes = params.wheel, []
    for slot in np.flatnonzero(wheel.active[body]):
        name = f"{spec.names[body]}.wheel{slot}"
        heading = float(wheel.heading[body, slot])
        across = np.array([-math.sin(heading), math.cos(heading)])
        sides = {name: 0.0}
        if wheel.half_track is not None and wheel.half_track[body, slot] > 0.0:
            half = float(wheel.half_track[body, slot])
            sides = {f"{name}.left": half, f"{name}.right": -half}
        for site, offset in sides.items():
            place = wheel.position[body, slot] + offset * across
            ET.SubElement(
                element,
                "site",
                name=site,
                pos=numbers((*place, 0.0)),
                euler=numbers((0.0, 0.0, heading)),
            )
            for i, direction in enumerate(("rolling", "lateral")):
                viscous = float(wheel.viscous[body, slot, i]) / len(sides)
                limit = float(wheel.dry[body, slot, i]) / len(sides)
                if viscous > 0.0 and limit > 0.0:
                    law = velocity_force(
                        viscous,
                        limit,
                        name=f"{site}.{direction}",
                        site=site,
                        gear=("1 0 0 0 0 0", "0 1 0 0 0 0")[i],
                    )
                    ET.SubElement(actuators, "general", law)
        acts = (wheel.viscous[body, slot] > 0.0) & (wheel.dry[body, slot] > 0.0)
        if np.all(acts) and np.any(np.isfinite(wheel.dry[body, slot])):
            notes.append(f"{name}: limits are a box, not an ellipse")
    return notes


def add_ground(
    element: ET.Element,
    actuators: ET.Element,
    spec: SceneSpec,
    params: Params,
    body: int,
) -> list[str]:
    """Let a body's feet rub on the floor.

    Args:
        element: the body's.
        actuators: section of the document.
        spec: the scene.
        params: the hypothesis, of NumPy arrays.
        body: which one.

    Returns:
        What is not exactly the engine's law.

    Raises:
        ValueError: there are two floors.
    """
    ground, owner = params.ground, spec.bodies[body]
    slots = np.flatnonzero(ground.active[body])
    if len(slots) > 1:
        raise ValueError(
            f"{spec.source}: body {owner.name!r}: expected one ground friction, got "
            f"{len(slots)}"
        )
    if not len(slots):
        return []
    at = body, int(slots[0])
    load = float(params.density[body]) * owner.area * spec.normal_gravity
    dry = float(ground.dry[at])
    limit = math.inf if math.isinf(dry) else dry * load
    viscous = float(ground.viscous[at])
    if not (viscous > 0.0 and limit > 0.0):
        return []
    share = 0.0 if ground.torque_share is None else float(ground.torque_share[at])
    shift = np.zeros(2) if ground.load_shift is None else ground.load_shift[at]
    # A body stands under its centre of mass as its feet stand about the origin.
    center = np.zeros(2)
    if params.center_of_mass is not None:
        center = np.asarray(params.center_of_mass[body])
    arms, loads, sizes = _stance(ground, at, owner)
    square = float(loads @ (np.sum(arms**2, axis=1) + sizes**2))
    feet = center + (1.0 - share) * arms + shift
    feet, loads = _as_points(feet, (1.0 - share) * sizes, loads)
    name = f"{owner.name}.ground"
    for i, (place, part) in enumerate(zip(feet, loads, strict=True)):
        if part <= 0.0:
            continue
        site = f"{name}.foot{i}"
        ET.SubElement(element, "site", name=site, pos=numbers((*place, 0.0)))
        for k, angle in enumerate(FOOT_ANGLES):
            law = velocity_force(
                FOOT_VISCOUS * part * viscous,
                FOOT_LIMIT * part * limit,
                name=f"{site}.{k}",
                site=site,
                gear=along(angle),
            )
            ET.SubElement(actuators, "general", law)
    arm = share * math.sqrt(square)
    if arm > 0.0:
        ET.SubElement(element, "site", name=f"{name}.spin")
        law = velocity_force(
            viscous * arm**2,
            limit * arm,
            name=f"{name}.spin",
            site=f"{name}.spin",
            gear="0 0 0 0 0 1",
        )
        ET.SubElement(actuators, "general", law)
    notes = [
        f"{name}: the limit of a foot depends on direction, by up to 6 %, and friction "
        "of what slides is up to 22.5 degrees off its direction"
    ]
    if np.any(owner.foot_size > 0.0):
        notes.append(f"{name}: two points stand for each foot that has a size")
    return notes


def _stance(
    ground: Ground, at: tuple[int, int], owner: BodySpec
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where feet are, their shares of the load, and their sizes, as `friction` does."""
    feet, loads, sizes = owner.feet, owner.foot_load, owner.foot_size
    if ground.corner_share is not None:
        gone = float(ground.corner_share[at])
        loads, sizes = loads + gone * (owner.corner_load - loads), (1.0 - gone) * sizes
    if ground.diagonal_share is not None:
        more = 2.0 * float(ground.diagonal_share[at]) - 1.0
        loads = loads * (1.0 + more * owner.diagonal)
    if ground.stance_scale is not None:
        scale = np.asarray(ground.stance_scale[at], float)
        cos, sin = math.cos(owner.stance_axis), math.sin(owner.stance_axis)
        turn = np.array([[cos, -sin], [sin, cos]])
        feet, sizes = (feet @ turn * scale) @ turn.T, sizes * math.sqrt(scale.prod())
    return feet, loads, sizes


def _as_points(
    feet: np.ndarray, sizes: np.ndarray, loads: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Feet and their loads, as two points at opposite edges each that has a size.

    Below the limit that is the same law; beyond, edges of half of the feet lie along
    one axis and those of the others along the other one, so that none is preferred.
    """
    if not np.any(sizes > 0.0):
        return feet, loads
    is_odd = np.arange(len(feet)) % 2 == 1
    edge = sizes[:, None] * np.stack([~is_odd, is_odd], axis=1)
    return np.concatenate([feet + edge, feet - edge]), np.tile(0.5 * loads, 2)
