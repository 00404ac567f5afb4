r"""Whether, and how, the robot with an arm can grasp an object and take it along a way.

Motions are planned in the robot's whole space of configurations: of the robot alone in
its five coordinates; with an object in the gripper in the three that the object's way
leaves (`ObjectWay`). Any planner of the form `planning.PlanMotion` will do
(`interop.plan_motion`).

Configurations that are checked have a margin to spare, and lie so near each other that
some of it is left in between. No pair of bodies needs more room than it has at first.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from boomdp_jax.envs.arm_clearance import ArmClearance, Held, relative
from boomdp_jax.envs.arm_grasps import grasp_candidates
from boomdp_jax.envs.arm_scene import ArmScene
from boomdp_jax.envs.object_way import ObjectWay
from boomdp_jax.physics.state import State
from boomdp_jax.planning.motion import (
    PlanMotion,
    TimedMotion,
    timed_motion,
)

_APPROACH = 0.06
"""Straight way, along the gripper, on which an object is approached [m]."""
_NUM_APPROACH = 13
"""Configurations of that way that are checked, 5 mm apart."""
_SLACK = 1e-3
"""Less room than at first that a pair may come to [m]."""
_IS_ANGLE = np.array([False, False, True, False, False])
"""Coordinates that have no bounds."""


class ArmMotion(NamedTuple):
    """A motion of the robot."""

    corners: Float[np.ndarray, "corner 5"]
    """Configurations at which it rests, first to last [m, m, rad, rad, rad]."""
    motion: TimedMotion
    """What `follow` takes."""


class Manipulation(NamedTuple):
    """A motion to an object, and one with it."""

    reach: ArmMotion
    carry: ArmMotion


@dataclasses.dataclass(frozen=True, eq=False)
class ManipulatorPlanner:
    """Plans grasps and ways of objects for the robot of a scene, host side.

    Raises:
        ValueError: a margin that is less than half of the resolution, so that bodies
            could touch between two configurations that are checked, or a least place
            that is not below the greatest.
    """

    world: ArmScene
    plan_motion: PlanMotion
    lower: tuple[float, float]
    """Where the middle of the base may be, at least [m]."""
    upper: tuple[float, float]
    """At most [m]."""
    margin: float = 0.03
    """Room that bodies have at configurations that are checked [m]."""
    resolution: float = 0.04
    """Largest motion of any point of the robot between two of these [m]."""
    speed: float = 0.6
    """Largest of any point of the robot [m/s]."""
    acceleration: float = 1.0
    """Likewise [m/s²]."""
    num_candidates: int = 512
    """Grasps that are looked at, and ends of a motion with an object."""
    num_goals: int = 16
    """Of those found, as many as are planned to."""

    def __post_init__(self) -> None:
        if not self.margin >= 0.5 * self.resolution > 0.0:
            raise ValueError(
                "margin: expected at least half of the resolution "
                f"({self.resolution:g} m), got {self.margin!r}"
            )
        if not np.all(np.asarray(self.lower) < np.asarray(self.upper)):
            raise ValueError(
                f"lower: expected numbers below upper = {self.upper}, got {self.lower}"
            )

    def grasps(
        self, seed: int, state: State, body: int, point: Float[np.ndarray, "2"]
    ) -> Float[np.ndarray, "grasp 5"]:
        """Free configurations in which the gripper can close on a point of an object.

        Args:
            seed: of the configurations that are looked at.
            state: where all is.
            body: index of the object.
            point: of it, in its frame; the nearest point of its outline is meant [m].

        Returns:
            Those of `num_candidates` that are free, as is the straight way to them,
            the gripper least tilted first.
        """
        pose = np.asarray(state.pose)
        found = grasp_candidates(
            seed,
            self.world.robot,
            self.world.spec.bodies[body],
            pose[body],
            point,
            self.num_candidates,
        )
        room = ArmClearance(self.world, pose)
        # The forearm comes as near to the object as it has to.
        is_grip = np.all(room.pairs == [self.world.bodies[-1], body], axis=1)
        margin = np.where(is_grip, 0.0, self.margin)
        found = found[self._within(found) & room.is_free(found, margin)]
        ways = np.array([self._approach(grasp) for grasp in found]).reshape(-1, 5)
        is_clear = room.is_free(ways, margin).reshape(len(found), _NUM_APPROACH)
        return found[is_clear.all(axis=1)]

    def move(
        self, seed: int, state: State, goals: Float[np.ndarray, "goal 5"]
    ) -> ArmMotion | None:
        """Move, with an empty gripper, to one of some configurations.

        What the gripper is at is left straight back first.

        Args:
            seed: of the planner.
            state: where all is, and the robot starts.
            goals: configurations, any of which will do [m, m, rad, rad, rad].

        Returns:
            The motion; None if none was found.
        """
        corners = self._moved(seed, state, goals)
        return None if corners is None else self._timed(corners)

    def reach(
        self, seed: int, state: State, grasps: Float[np.ndarray, "grasp 5"]
    ) -> ArmMotion | None:
        """Move, with an empty gripper, to one of some grasps.

        Args:
            seed: of the planner.
            state: where all is, and the robot starts.
            grasps: of the method `grasps`; the first `num_goals` of them count.

        Returns:
            The motion, its last corner the grasp but for whole turns of the base; None
            if none was found.
        """
        grasps = grasps[: self.num_goals]
        if not len(grasps):
            return None
        ways = np.stack([self._approach(grasp) for grasp in grasps])
        corners = self._moved(seed, state, ways[:, 0])
        if corners is None:
            return None
        offsets = ways[:, 0] - corners[None, -1]
        turns = 2.0 * np.pi * np.round(offsets[:, 2] / (2.0 * np.pi))
        offsets[:, 2] -= turns
        nearest = int(np.argmin(np.abs(offsets).sum(axis=1)))
        grasp = grasps[nearest] - turns[nearest] * _IS_ANGLE
        return self._timed(np.concatenate([corners, grasp[None]]))

    def carry(
        self,
        seed: int,
        state: State,
        grasp: Float[np.ndarray, "5"],
        body: int,
        poses: Float[np.ndarray, "pose 3"],
    ) -> ArmMotion | None:
        """Move with an object in the gripper, the object along a way of its own.

        Args:
            seed: of the planner, and of the ends that are looked at.
            state: where all is; of the robot only the grasp counts.
            grasp: configuration in which the object is held where it stands.
            body: index of the object.
            poses: where it is taken from there, one after another and straight in
                between, angles not wrapped [m, m, rad].

        Returns:
            The motion of the robot; None if none was found.
        """
        robot, pose = self.world.robot, np.asarray(state.pose)
        gripper = np.asarray(robot.gripper(jnp.asarray(grasp)))
        held = Held(body, relative(gripper, pose[body]))
        way = ObjectWay(
            robot,
            relative(pose[body], gripper),
            np.concatenate([pose[None, body], poses]),
        )
        room = ArmClearance(self.world, pose, held)
        margin = self._margin(room, grasp)

        def is_free(points: np.ndarray) -> Bool[np.ndarray, " point"]:
            found = way.configurations(points)
            return self._within(found) & room.is_free(found, margin)

        start = np.array([0.0, *grasp[3:]])
        limit = robot.joint_limit
        corners = self.plan_motion(
            seed,
            start,
            self._ends(seed, start, way, is_free),
            is_free,
            np.array([-_SLACK, *-limit]),
            np.array([way.length + _SLACK, *limit]),
            levers=way.levers,
            resolution=self.resolution,
        )
        if corners is None:
            return None
        return self._carried(way, way.with_bends(corners))

    def manipulate(
        self,
        seed: int,
        state: State,
        body: int,
        point: Float[np.ndarray, "2"],
        poses: Float[np.ndarray, "pose 3"],
    ) -> Manipulation | None:
        """Reach for a point of an object, and take it along a way.

        Args:
            seed: of everything random.
            state: where all is, and the robot starts.
            body: index of the object.
            point: of it, in its frame [m].
            poses: of the object, as in `carry`.

        Returns:
            Both motions, of the first of `num_goals` grasps that has both; None if
            none of them has.
        """
        for grasp in self.grasps(seed, state, body, point)[: self.num_goals]:
            carry = self.carry(seed, state, grasp, body, poses)
            if carry is None:
                continue
            reach = self.reach(seed, state, grasp[None])
            if reach is not None:
                return Manipulation(reach, carry)
        return None

    def _approach(self, grasp: np.ndarray) -> Float[np.ndarray, "point 5"]:
        """The straight way to a grasp, the arm as it is."""
        angle = grasp[2:].sum()
        back = np.array([np.cos(angle), np.sin(angle), 0.0, 0.0, 0.0])
        share = np.linspace(1.0, 0.0, _NUM_APPROACH)
        return grasp[None] - _APPROACH * share[:, None] * back[None]

    def _moved(
        self, seed: int, state: State, goals: np.ndarray
    ) -> Float[np.ndarray, "corner 5"] | None:
        room = ArmClearance(self.world, np.asarray(state.pose))
        start = np.asarray(self.world.configuration(state))
        limit = self.world.robot.joint_limit
        first, margin = start[None], self._margin(room, start)
        is_forearm = room.pairs[:, 0] == self.world.bodies[-1]
        if np.any(margin[is_forearm] < self.margin):
            # First away from what the gripper is at, straight back.
            back = self._approach(start)[::-1]
            if np.all(self._within(back) & room.is_free(back, margin)):
                first = np.stack([start, back[-1]])
                margin = self._margin(room, back[-1])
        corners = self.plan_motion(
            seed,
            first[-1],
            goals,
            lambda found: room.is_free(found, margin),
            np.array([*self.lower, -np.pi, *-limit]),
            np.array([*self.upper, np.pi, *limit]),
            levers=self.world.robot.levers,
            resolution=self.resolution,
            is_periodic=_IS_ANGLE,
        )
        return None if corners is None else np.concatenate([first[:-1], corners])

    def _margin(
        self, room: ArmClearance, start: np.ndarray
    ) -> Float[np.ndarray, " pair"]:
        """Room that each pair needs on a motion from somewhere [m]."""
        at_first = room.clearance(start[None])[0] - _SLACK
        return np.clip(at_first, 0.0, self.margin)

    def _within(self, configurations: np.ndarray) -> Bool[np.ndarray, " point"]:
        base = configurations[:, :2]
        return np.all((base >= self.lower) & (base <= self.upper), axis=1)

    def _ends(
        self, seed: int, start: np.ndarray, way: ObjectWay, is_free
    ) -> Float[np.ndarray, "goal 3"]:
        """Free points at the end of a way, the arm least bent from the start first."""
        rng, limit = np.random.default_rng(seed), self.world.robot.joint_limit
        angles = rng.uniform(-limit, limit, (self.num_candidates, 2))
        bent = np.abs(angles - start[None, 1:]) @ way.levers[1:]
        angles = np.concatenate([start[None, 1:], angles[np.argsort(bent)]])
        ends = np.column_stack([np.full(len(angles), way.length), angles])
        return ends[is_free(ends)][: self.num_goals]

    def _timed(self, corners: np.ndarray) -> ArmMotion:
        motion = timed_motion(
            corners,
            self.world.robot.levers,
            speed=self.speed,
            acceleration=self.acceleration,
            dt=self.world.spec.dt,
        )
        return ArmMotion(corners, motion)

    def _carried(self, way: ObjectWay, corners: np.ndarray) -> ArmMotion:
        """The robot's coordinates in place of the way's."""
        dt = self.world.spec.dt
        timed = timed_motion(
            corners,
            way.levers,
            speed=self.speed,
            acceleration=self.acceleration,
            dt=dt,
        )
        points = np.concatenate([corners[:1], timed.configuration])
        found = way.configurations(points)
        rate = np.gradient(found, dt, axis=0) if len(found) > 1 else 0.0 * found
        change = np.gradient(rate, dt, axis=0) if len(found) > 1 else 0.0 * found
        motion = TimedMotion(found[1:], rate[1:], change[1:])
        return ArmMotion(way.configurations(corners), motion)
