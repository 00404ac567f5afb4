"""How the bodies of a planar scene hang on each other in MuJoCo's tree.

A joint between two bodies becomes a degree of freedom of the one that is further from
the world, and holds exactly. Where joints form a loop one of them is left over, to be
held by an equality; drawers and welds go into the tree first, then pins that have
friction, limits or motors, since an equality has none.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from boomdp_jax.interop.mjcf_elements import turned
from boomdp_jax.physics.params import WORLD, Params
from boomdp_jax.physics.scene_spec import SceneSpec

TREE_KINDS = ("prismatic", "weld", "revolute")
"""Kinds of joints that can be degrees of freedom, or the lack of any, of the tree."""


class Joint(NamedTuple):
    """An active slot of a kind."""

    kind: str
    slot: int
    body_a: int
    body_b: int


@dataclasses.dataclass(frozen=True)
class Hold:
    """What holds one body, and where its frame is while its joint is at zero."""

    body: int
    kind: str
    """static, free, or the kind of its joint."""
    parent: int = WORLD
    slot: int = -1
    is_a: bool = True
    """Whether the body is `a` of its joint, the parent `b`."""
    place: Float[np.ndarray, "2"] = dataclasses.field(
        default_factory=lambda: np.zeros(2)
    )
    """In the parent's frame [m]."""
    turn: float = 0.0
    """Against the parent's frame [rad]."""


def active_joints(params: Params, kinds: tuple[str, ...]) -> list[Joint]:
    """Joints that exist in a hypothesis.

    Args:
        params: of NumPy arrays, unbatched.
        kinds: which ones.

    Returns:
        Active slots, kind by kind.
    """
    found = []
    for kind in kinds:
        slots = getattr(params, kind)
        if slots is None:
            continue
        for slot in np.flatnonzero(slots.active):
            ends = int(slots.body_a[slot]), int(slots.body_b[slot])
            found.append(Joint(kind, int(slot), *ends))
    return found


def hang(spec: SceneSpec, params: Params) -> tuple[list[Hold], list[Joint]]:
    """Choose which joints are those of the tree.

    Args:
        spec: the scene.
        params: one hypothesis, of NumPy arrays.

    Returns:
        How each body is held, parents first, and the joints that are left over.

    Raises:
        ValueError: a drawer closes a loop.
    """
    fixed = {WORLD} | set(np.flatnonzero(spec.is_static).tolist())
    island = {body: body for body in range(spec.num_bodies)}
    island |= dict.fromkeys(fixed, WORLD)
    chosen: list[Joint] = []
    loops: list[Joint] = []
    joints = active_joints(params, TREE_KINDS)
    joints.sort(key=lambda joint: joint.kind == "revolute" and _is_plain(params, joint))
    for joint in joints:
        one, other = island[joint.body_a], island[joint.body_b]
        if one != other:
            chosen.append(joint)
            island = {k: one if v == other else v for k, v in island.items()}
        elif joint.kind == "prismatic":
            raise ValueError(
                f"{spec.source}: prismatic of body {spec.names[joint.body_a]!r}: "
                "expected no loop, which MuJoCo cannot close by a slide, got one"
            )
        else:
            loops.append(joint)
    holds = [
        Hold(body, "static", place=spec.pose[body, :2], turn=float(spec.pose[body, 2]))
        for body in sorted(fixed - {WORLD})
    ]
    placed = set(fixed)
    while len(placed) <= spec.num_bodies:
        edges = [j for j in chosen if (j.body_a in placed) != (j.body_b in placed)]
        if not edges:
            free = min(set(range(spec.num_bodies)) - placed)
            holds.append(Hold(free, "free"))
            placed.add(free)
        for joint in edges:
            is_a = joint.body_b in placed
            body, parent = (
                (joint.body_a, joint.body_b) if is_a else (joint.body_b, joint.body_a)
            )
            place, turn = _frame(params, joint, is_a)
            hold = Hold(body, joint.kind, parent, joint.slot, is_a, place, turn)
            holds.append(hold)
            placed.add(body)
    return holds, loops


def rest_poses(holds: list[Hold]) -> dict[int, Float[np.ndarray, "3"]]:
    """Where bodies are while every joint is at zero, MuJoCo's reference.

    Args:
        holds: how bodies are held, parents first.

    Returns:
        Pose of each, and of the world [m, m, rad].
    """
    poses = {WORLD: np.zeros(3)}
    for hold in holds:
        x, y, angle = poses[hold.parent]
        place = np.array([x, y]) + turned(hold.place, angle)
        poses[hold.body] = np.array([*place, angle + hold.turn])
    return poses


def start_coordinates(
    holds: list[Hold],
    params: Params,
    pose: Float[np.ndarray, "body 3"],
    twist: Float[np.ndarray, "body 3"],
) -> tuple[list[float], list[float]]:
    """Joint coordinates and their rates, in the order of the holds given.

    Args:
        holds: how bodies are held, in MuJoCo's order.
        params: the hypothesis, of NumPy arrays.
        pose: of every body [m, m, rad].
        twist: their rates.

    Returns:
        `qpos` and `qvel`.
    """
    positions: list[float] = []
    rates: list[float] = []
    for hold in holds:
        own, rate = pose[hold.body], twist[hold.body]
        base, base_rate = np.zeros(3), np.zeros(3)
        if hold.parent != WORLD:
            base, base_rate = pose[hold.parent], twist[hold.parent]
        if hold.kind == "free":
            positions += own.tolist()
            rates += rate.tolist()
        elif hold.kind == "revolute":
            sign = 1.0 if hold.is_a else -1.0
            positions.append(float(sign * (own[2] - base[2])))
            rates.append(float(sign * (rate[2] - base_rate[2])))
        elif hold.kind == "prismatic":
            a, b = (own, base) if hold.is_a else (base, own)
            rate_a, rate_b = (rate, base_rate) if hold.is_a else (base_rate, rate)
            slots = getattr(params, hold.kind)
            arm_a = turned(slots.anchor_a[hold.slot], a[2])
            arm_b = turned(slots.anchor_b[hold.slot], b[2])
            line = turned(np.array([1.0, 0.0]), b[2] + float(slots.axis[hold.slot]))
            slide = a[:2] + arm_a - b[:2] - arm_b
            speed = rate_a[:2] + rate_a[2] * _across(arm_a)
            speed = speed - rate_b[:2] - rate_b[2] * _across(arm_b + slide)
            positions.append(float(line @ slide))
            rates.append(float(line @ speed))
    return positions, rates


def _is_plain(params: Params, joint: Joint) -> bool:
    """Whether a pin has neither friction nor limits nor a motor."""
    pins, slot = params.revolute, joint.slot
    has_limit = pins.limit is not None and np.any(np.isfinite(pins.limit[slot]))
    has_motor = pins.motor is not None and pins.motor[slot, 1] > 0
    has_friction = pins.viscous[slot] > 0 and pins.dry[slot] > 0
    return not (has_limit or has_motor or has_friction)


def _frame(
    params: Params, joint: Joint, is_a: bool
) -> tuple[Float[np.ndarray, "2"], float]:
    """Frame of the child in its parent's, where anchors coincide."""
    slots = getattr(params, joint.kind)
    own, base = slots.anchor_a[joint.slot], slots.anchor_b[joint.slot]
    turn = 0.0 if joint.kind == "revolute" else float(slots.angle[joint.slot])
    if not is_a:
        own, base, turn = base, own, -turn
    return base - turned(own, turn), turn


def _across(arm: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
    return np.array([-arm[1], arm[0]])
