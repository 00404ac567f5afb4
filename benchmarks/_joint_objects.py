"""Doors, drawers and fixed things in MuJoCo, handled by forces at a handle.

MuJoCo's hinge and slide joints hold exactly; their friction is its own: damping and
friction loss add up, where our joints have a viscous coefficient under a dry limit.
"""

from typing import Any, NamedTuple

import mujoco
import numpy as np

from boomdp_jax.core.history import History, make_history
from boomdp_jax.physics.scene_spec import (
    SCENE_SCHEMA,
    STANDARD_GRAVITY,
    SceneSpec,
    scene_spec_from_dict,
)

KINDS = {"door": "revolute", "drawer": "prismatic", "fixed": "weld"}
"""What holds an object of each kind."""

UNKNOWN = {"revolute": 1, "prismatic": 1, "weld": 1, "ground": 1}
"""What a learner must reckon with, whatever the kind."""

DT = 0.05
"""Between readings [s]: a camera's 20 frames a second."""
NUM_INTERACTIONS, NUM_ROWS = 8, 40
NOISE = (1e-3, 1e-3, 1e-3, 4e-3, 4e-3, 4e-3)
"""Of readings: 1 mm, 1 mrad, 4 mm/s, 4 mrad/s."""

_TICK = 0.001
_TRIAL_TICK = 0.005
_TARGET_SPEED = 0.2
"""Of the handle, root mean square [m/s]."""


class JointObject(NamedTuple):
    """The truth about one object."""

    kind: str
    half: np.ndarray
    """Half extents of its outline, a box [m]."""
    mass: float
    pose: np.ndarray
    """Of its centre of mass where its joint is at zero [m, m, rad]."""
    hinge: np.ndarray
    """In the frame of the body [m]."""
    axis: float
    """Of a drawer, in the world [rad]."""
    damping: float
    """[N m s/rad] or [N s/m]."""
    loss: float
    """Friction loss [N m] or [N]."""
    handle: np.ndarray
    """In the frame of the body [m]."""
    stop: float = np.inf
    """How far it goes either way [m] or [rad]."""

    @property
    def size(self) -> float:
        """Longer side of the outline [m]."""
        return 2.0 * float(np.max(self.half))

    @property
    def hinge_in_world(self) -> np.ndarray:
        """Where a door hangs [m]."""
        return self.pose[:2] + rotate(self.pose[2], self.hinge)


def rotate(angle: float, vector: np.ndarray) -> np.ndarray:
    """A vector turned by an angle."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]]) @ vector


def random_object(
    rng: np.random.Generator, kind: str, *, has_stops: bool = False
) -> JointObject:
    """Draw an object: sides of 0.2 to 1 m, density of 5 to 100 kg/m².

    Args:
        rng: source of randomness.
        kind: one of `KINDS`.
        has_stops: whether it goes 0.05 to 0.25 m, or rad, either way.
    """
    half = rng.uniform(0.1, 0.5, 2)
    mass = float(np.exp(rng.uniform(np.log(5.0), np.log(100.0)))) * 4.0 * half.prod()
    hinge = rng.uniform(-0.95, 0.95, 2) * half
    inertia = mass * ((half**2).sum() / 3.0 + (hinge**2).sum())
    is_door = kind == "door"
    rate = np.exp(rng.uniform(np.log(0.05), np.log(1.0)))
    share = np.exp(rng.uniform(np.log(0.005), np.log(0.1)))
    arm = np.sqrt(inertia / mass) if is_door else 1.0
    corners = half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    # A handle far from the hinge, as handles are.
    far = corners[np.argmax(((corners - hinge) ** 2).sum(1))]
    return JointObject(
        kind=kind,
        half=half,
        mass=float(mass),
        pose=np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-np.pi, np.pi)]),
        hinge=hinge,
        axis=float(rng.uniform(-np.pi / 2, np.pi / 2)),
        damping=float(rate * (inertia if is_door else mass)),
        loss=float(share * mass * STANDARD_GRAVITY * arm),
        handle=0.9 * far,
        stop=float(rng.uniform(0.05, 0.25)) if has_stops else np.inf,
    )


def scene_of(thing: JointObject) -> SceneSpec:
    """What a learner gets to see."""
    body = {
        "name": "object",
        "shape": {"type": "box", "half_extents": thing.half.tolist()},
    }
    return scene_spec_from_dict(
        {
            "schema": SCENE_SCHEMA,
            "dt": DT,
            "gravity": [0.0, 0.0],
            "bodies": [body],
            "unknown": UNKNOWN,
        },
        source="object",
    )


def handled(rng: np.random.Generator, thing: JointObject) -> History:
    """Handle an object a few times, and read it with noise.

    Each interaction starts at rest, somewhere along what the joint leaves free (with
    stops, within 0.8 of the way to them). A force
    at the handle rises and falls twice, in a random direction and back; it is given as
    the wrench at the centre of mass that it amounts to as a row begins, held over the
    row. Forces are such that the handle moves at 0.2 m/s, root mean square; a fixed
    thing is pushed with 5 to 100 N.
    """
    starts = rng.uniform(-0.5, 0.5, NUM_INTERACTIONS)
    starts *= min(1.0, 1.6 * thing.stop)
    directions = rng.uniform(-np.pi, np.pi, NUM_INTERACTIONS)
    strengths = rng.uniform(0.6, 1.0, NUM_INTERACTIONS)
    time = DT * (np.arange(NUM_ROWS) + 0.5)
    profile = np.sin(2.0 * np.pi * time / 2.0) * np.sin(np.pi * time / 2.0)
    unit = np.stack([np.cos(directions), np.sin(directions)], -1) * strengths[:, None]
    forces = unit[:, None] * profile[None, :, None]
    force = float(np.exp(rng.uniform(np.log(5.0), np.log(100.0))))
    if thing.kind != "fixed":
        force = _fitting_force(thing, forces, starts)
    state, wrench = _simulate(thing, force * forces, starts, _TICK)
    state = state + np.array(NOISE) * rng.standard_normal(state.shape)
    return make_history(
        state[:, :-1].reshape(-1, 1, 6),
        wrench.reshape(-1, 1, 3),
        state[:, 1:].reshape(-1, 1, 6),
        DT,
        episode=np.repeat(np.arange(NUM_INTERACTIONS), NUM_ROWS),
    )


def _fitting_force(thing: JointObject, forces: np.ndarray, starts: np.ndarray) -> float:
    """Force at which the handle moves as fast as it should."""
    arm = np.hypot(*(thing.handle - thing.hinge)) if thing.kind == "door" else 1.0
    low, high = 1e-3, 1e5
    for _ in range(14):
        force = float(np.sqrt(low * high))
        state, _ = _simulate(thing, force * forces, starts, _TRIAL_TICK)
        speed = state[..., 5] * arm if thing.kind == "door" else state[..., 3:5]
        is_slow = np.sqrt(np.sum(speed**2) / state[..., 0].size) < _TARGET_SPEED
        low, high = (force, high) if is_slow else (low, force)
    return force


def _simulate(
    thing: JointObject, forces: np.ndarray, starts: np.ndarray, tick: float
) -> tuple[np.ndarray, np.ndarray]:
    """True channels `[interaction, row + 1, 6]` and wrenches `[.., row, 3]`."""
    model = mujoco.MjModel.from_xml_string(_world_text(thing, tick))
    data = mujoco.MjData(model)
    num_ticks = round(DT / tick)
    state = np.zeros((len(starts), forces.shape[1] + 1, 6))
    wrench = np.zeros((*forces.shape[:2], 3))
    for number, (start, pushes) in enumerate(zip(starts, forces, strict=True)):
        mujoco.mj_resetData(model, data)
        data.qpos[:] = start
        state[number, 0] = _channels(thing, data)
        for row, force in enumerate(pushes):
            arm = rotate(state[number, row, 2], thing.handle)
            wrench[number, row] = [*force, arm[0] * force[1] - arm[1] * force[0]]
            data.body("object").xfrc_applied[[0, 1, 5]] = wrench[number, row]
            mujoco.mj_step(model, data, num_ticks)
            state[number, row + 1] = _channels(thing, data)
    return state, wrench


def _channels(thing: JointObject, data: Any) -> np.ndarray:
    """Pose and twist of the centre of mass."""
    if thing.kind == "fixed":
        return np.append(thing.pose, np.zeros(3))
    place, speed = data.qpos[0], data.qvel[0]
    if thing.kind == "drawer":
        direction = np.array([np.cos(thing.axis), np.sin(thing.axis)])
        return np.array(
            [
                *(thing.pose[:2] + place * direction),
                thing.pose[2],
                *(speed * direction),
                0,
            ]
        )
    angle = thing.pose[2] + place
    arm = -rotate(angle, thing.hinge)
    return np.array(
        [*(thing.hinge_in_world + arm), angle, -speed * arm[1], speed * arm[0], speed]
    )


def _world_text(thing: JointObject, tick: float) -> str:
    """The model, seen from above: no gravity, no contact."""
    x, y, angle = thing.pose
    inertia = thing.mass * (thing.half**2).sum() / 3.0
    friction = f'damping="{thing.damping}" frictionloss="{thing.loss}"'
    if np.isfinite(thing.stop):
        # Of four ticks' time, and without a bounce.
        friction += f' range="{-thing.stop} {thing.stop}" limited="true"'
        friction += f' solreflimit="{4 * tick} 1"'
    local = thing.axis - angle
    joint = {
        "door": f'<joint type="hinge" axis="0 0 1" {friction} '
        f'pos="{thing.hinge[0]} {thing.hinge[1]} 0"/>',
        "drawer": f'<joint type="slide" {friction} '
        f'axis="{np.cos(local)} {np.sin(local)} 0"/>',
        "fixed": "",
    }[thing.kind]
    return f"""<mujoco>
      <compiler angle="radian"/>
      <option timestep="{tick}" gravity="0 0 0" integrator="implicitfast"/>
      <worldbody>
        <body name="object" pos="{x} {y} 0" euler="0 0 {angle}">
          {joint}
          <inertial pos="0 0 0" mass="{thing.mass}"
            diaginertia="{inertia} {inertia} {inertia}"/>
        </body>
      </worldbody>
    </mujoco>"""
