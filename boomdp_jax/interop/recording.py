"""Recordings of pushed objects, made in MuJoCo: what the laboratory's camera would see.

The truth is a scene of the usual kind with nothing left open. MuJoCo moves it under
wrenches that are held over a record step and applied at the centre of mass; what comes
back is the table of a transition file. Reading noise is added afterwards, so that one
recording serves many noise levels.
"""

import dataclasses
import types
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from boomdp_jax.core.checked_input import (
    episode_array,
    has_shape,
    reading_scale,
    real_array,
)
from boomdp_jax.core.transition_table import TransitionTable
from boomdp_jax.interop.mjcf import RecordingLaws, has_contacts, world_text
from boomdp_jax.interop.mjcf_document import load_mujoco
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene_spec import SceneSpec

READING_NOISE = (0.001, 0.001, 0.005, 0.005)
"""Standard reading noise: position [m], angle [rad], velocity [m/s], spin [rad/s]."""

_SETTLE_SECONDS = 0.2
_CHANNEL = np.array([0, 0, 1, 2, 2, 3])


def record(
    truth: SceneSpec,
    wrenches: Float[np.ndarray, "time 3"],
    *,
    episode: Int[np.ndarray, " time"] | None = None,
    start: Float[np.ndarray, "episode 3"] | None = None,
    laws: RecordingLaws | None = None,
) -> TransitionTable:
    """Push an object in MuJoCo and write down its exact states.

    Each episode starts from rest, on the pin if there is one. Feet are given a moment
    to settle before the first reading.

    Args:
        truth: scene with one body, of which everything is known.
        wrenches: force and torque at the centre of mass, world frame [N, N, N m], one
            for each step of the scene's length.
        episode: which run a row belongs to, in order of time; default: one run.
        start: pose of the centre of mass at the start of each run [m, m, rad]; of a
            pinned object only the angle counts. Default: the scene's pose.
        laws: which of MuJoCo's elements stand for the constraints.

    Returns:
        True states before and after each step; neighbouring rows of an episode share
        their state to the bit.

    Raises:
        ValueError: more than one body, more constraints than MuJoCo is asked to carry
            here, a time step that does not divide the scene's, or wrenches, runs or
            starts that do not fit each other or are not finite.
        RuntimeError: MuJoCo became unstable, and put the object back by itself.
        ImportError: MuJoCo is not installed.
    """
    laws = RecordingLaws() if laws is None else laws
    params = _single_object(truth)
    num_ticks = round(truth.dt / laws.time_step)
    if num_ticks < 1 or abs(num_ticks * laws.time_step - truth.dt) > 1e-9:
        raise ValueError(
            f"laws: expected a time step that divides dt = {truth.dt} s, got "
            f"{laws.time_step}"
        )
    wrenches = _finite_rows("wrenches", wrenches)
    num_rows = len(wrenches)
    given = np.zeros(num_rows, int) if episode is None else episode
    episode = episode_array(given, num_rows)
    first = np.flatnonzero(np.diff(episode, prepend=np.nan))
    if start is None:
        start = np.tile(np.nan_to_num(truth.pose[0]), (len(first), 1))
    # The pin says where a pinned object is.
    used = slice(2 if params.revolute.active.any() else 0, 3)
    start = _finite_rows("start", start, len(first), used=used)
    world = _World.build(truth, params, laws)
    state = np.zeros((num_rows, 1, 6))
    next_state = np.zeros((num_rows, 1, 6))
    ends = [*first[1:], num_rows]
    for begin, end, pose in zip(first, ends, start, strict=True):
        world.reset(pose)
        for row in range(begin, end):
            state[row, 0] = world.state()
            world.push(wrenches[row], num_ticks)
            next_state[row, 0] = world.state()
            if not world.is_stable():
                raise RuntimeError(
                    "wrenches: expected some under which MuJoCo is stable, got "
                    f"{wrenches[row].tolist()} in row {row}, where it is not"
                )
    return TransitionTable(
        state=state,
        action=wrenches[:, None, :].copy(),
        next_state=next_state,
        dt=np.full(num_rows, truth.dt),
        episode=episode,
        point=None,
        params=None,
        source="recording",
    )


def with_reading_noise(
    rng: np.random.Generator,
    table: TransitionTable,
    scale: Float[np.ndarray, "4"] | tuple[float, float, float, float] = READING_NOISE,
    *,
    is_chained: bool = True,
) -> TransitionTable:
    """Add independent normal noise to every reading.

    Args:
        rng: source of randomness.
        table: true states.
        scale: sd of position [m], angle [rad], velocity [m/s] and spin [rad/s].
        is_chained: whether the end of a step and the start of the next are one
            reading, or two readings of the same instant.

    Returns:
        The noisy table.

    Raises:
        ValueError: not four numbers, or one that is negative or not finite.
    """
    sd = reading_scale("scale", scale)[_CHANNEL]
    state = table.state + sd * rng.standard_normal(table.state.shape)
    next_state = table.next_state + sd * rng.standard_normal(table.state.shape)
    if is_chained:
        follows = np.flatnonzero(np.diff(table.episode) == 0) + 1
        state[follows] = next_state[follows - 1]
    return dataclasses.replace(table, state=state, next_state=next_state)


def _finite_rows(
    name: str, values: Any, num_rows: int | None = None, *, used: slice = slice(None)
) -> Float[np.ndarray, "row 3"]:
    """Rows of three numbers; from one that is not finite MuJoCo would start afresh."""
    rows = real_array(name, values)
    if not has_shape(rows.shape, ("row" if num_rows is None else num_rows, 3)):
        wanted = "[time, 3]" if num_rows is None else f"{(num_rows, 3)}"
        raise ValueError(f"{name}: expected shape {wanted}, got {rows.shape}")
    is_wrong = ~np.isfinite(rows[:, used]).all(axis=1)
    if np.any(is_wrong):
        row = int(np.argmax(is_wrong))
        raise ValueError(
            f"{name}: expected finite numbers, got {rows[row].tolist()} in row {row}"
        )
    return rows


def _single_object(truth: SceneSpec) -> Params:
    """Numbers of the object on the host, checked for what MuJoCo can carry here."""
    if truth.num_bodies != 1:
        raise ValueError(f"truth: expected one body, got {truth.num_bodies}")
    params = jax.tree.map(np.asarray, truth.params())
    most = {"revolute": 1, "distance": 0, "wheel": 1, "ground": 1}
    for each in truth.constraints:
        if each.kind not in most or {"limit", "motor"} & each.numbers.keys():
            raise ValueError(
                f"truth: expected {', '.join(most)} without limits and motors, got "
                f"{each.kind} with {', '.join(each.numbers)}"
            )
    for kind, cap in most.items():
        count = int(getattr(params, kind).active.sum())
        if count > cap:
            raise ValueError(f"truth: expected at most {cap} {kind}, got {count}")
    return params


@dataclasses.dataclass
class _World:
    """A MuJoCo model of one object, and how its joints are read."""

    mujoco: types.ModuleType
    model: Any
    data: Any
    pin: Float[np.ndarray, "2"] | None
    """World point of a hinge; None: the object has joints x and y."""
    anchor: Float[np.ndarray, "2"]
    """The hinge, or the pin's place, in the body frame."""
    is_pinned: bool
    origin: Float[np.ndarray, "2"]
    """Where the centre of mass is when all joints are at zero."""
    num_settle: int

    @classmethod
    def build(cls, truth: SceneSpec, params: Params, laws: RecordingLaws) -> "_World":
        mujoco = load_mujoco()
        model = mujoco.MjModel.from_xml_string(world_text(truth, params, laws))
        is_pinned = bool(params.revolute.active.any())
        anchor, pin = np.zeros(2), None
        origin = np.zeros(2)
        if is_pinned:
            anchor = np.asarray(params.revolute.anchor_a[0], float)
            world_point = np.asarray(params.revolute.anchor_b[0], float)
            origin = world_point - anchor
            pin = world_point if laws.pin == "hinge" else None
        num_settle = 0
        if has_contacts(truth, params, laws):
            num_settle = round(_SETTLE_SECONDS / laws.time_step)
        data = mujoco.MjData(model)
        return cls(mujoco, model, data, pin, anchor, is_pinned, origin, num_settle)

    def reset(self, pose: Float[np.ndarray, "3"]) -> None:
        """Put the object down at rest."""
        self.mujoco.mj_resetData(self.model, self.data)
        joint = self.data.joint
        joint("theta").qpos = pose[2]
        if self.pin is None:
            place = pose[:2]
            if self.is_pinned:
                place = self.origin + self.anchor - _rotate(pose[2], self.anchor)
            joint("x").qpos, joint("y").qpos = place - self.origin
        if self.num_settle:
            gravity = self.model.opt.gravity.copy()
            self.model.opt.gravity[:2] = 0.0
            self.mujoco.mj_step(self.model, self.data, self.num_settle)
            self.model.opt.gravity[:] = gravity

    def push(self, wrench: Float[np.ndarray, "3"], num_ticks: int) -> None:
        """Hold a wrench at the centre of mass for a record step."""
        self.data.body("object").xfrc_applied[[0, 1, 5]] = wrench
        self.mujoco.mj_step(self.model, self.data, num_ticks)

    def is_stable(self) -> bool:
        """Whether MuJoCo has put nothing back to the beginning since `reset`."""
        warning = self.mujoco.mjtWarning
        return not any(
            self.data.warning[int(each)].number
            for each in (
                warning.mjWARN_BADQPOS,
                warning.mjWARN_BADQVEL,
                warning.mjWARN_BADQACC,
            )
        )

    def state(self) -> Float[np.ndarray, "6"]:
        """Pose and twist of the centre of mass."""
        joint = self.data.joint
        angle, spin = joint("theta").qpos[0], joint("theta").qvel[0]
        if self.pin is not None:
            arm = -_rotate(angle, self.anchor)
            place = self.pin + arm
            speed = spin * np.array([-arm[1], arm[0]])
        else:
            place = [
                self.origin[0] + joint("x").qpos[0],
                self.origin[1] + joint("y").qpos[0],
            ]
            speed = np.array([joint("x").qvel[0], joint("y").qvel[0]])
        return np.array([*place, angle, *speed, spin])


def _rotate(angle: float, vector: np.ndarray) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]]) @ vector
