"""A way that an object is to be taken, and the configurations of a robot that holds it.

Where the object is on its way is one number, the distance done; with it the gripper is
given, and shoulder and elbow are free. Three coordinates, then, in place of the
robot's five: the others are held by the object.
"""

import dataclasses
import functools
import itertools

import numpy as np
from jaxtyping import Float

from boomdp_jax.envs.arm_grasps import holding
from boomdp_jax.envs.mobile_arm import MobileArm


@dataclasses.dataclass(frozen=True, eq=False)
class ObjectWay:
    """The way of a held object; points of it are distance [m], shoulder, elbow [rad].

    Distance counts what the point of the robot that moves most may move while shoulder
    and elbow stay as they are, so that its lever is one.
    """

    robot: MobileArm
    gripper: Float[np.ndarray, "3"]
    """In the object's frame [m, m, rad]."""
    poses: Float[np.ndarray, "pose 3"]
    """Of the object [m, m, rad]."""

    @property
    def levers(self) -> Float[np.ndarray, "3"]:
        """How far the point that moves most moves for a change of each coordinate.

        About the gripper the base turns with the shoulder, and base and upper arm with
        the elbow [1, m/rad, m/rad].
        """
        robot = self.robot
        base = robot.shoulder + robot.base_radius
        return np.array([1.0, base, robot.upper_arm + base])

    @functools.cached_property
    def distance(self) -> Float[np.ndarray, " pose"]:
        """Done at each of the poses [m]."""
        robot = self.robot
        extent = np.hypot(*self.gripper[:2]) + robot.forearm + robot.half_width
        extent = extent + robot.upper_arm + robot.shoulder + robot.base_radius
        steps = np.abs(np.diff(self.poses, axis=0))
        lengths = np.hypot(steps[:, 0], steps[:, 1]) + extent * steps[:, 2]
        return np.concatenate([[0.0], np.cumsum(lengths)])

    @property
    def length(self) -> float:
        """Of the whole way [m]."""
        return float(self.distance[-1])

    def configurations(
        self, points: Float[np.ndarray, "point 3"]
    ) -> Float[np.ndarray, "point 5"]:
        """Configurations of the robot at points of the way.

        Args:
            points: distance [m], shoulder and elbow [rad].

        Returns:
            q [m, m, rad, rad, rad]; headings turn as the object's angle does.
        """
        objects = np.column_stack(
            [np.interp(points[:, 0], self.distance, part) for part in self.poses.T]
        )
        grippers = np.repeat(self.gripper[None], len(points), axis=0)
        return holding(self.robot, objects, grippers, points[:, 1:])

    def with_bends(
        self, corners: Float[np.ndarray, "corner 3"]
    ) -> Float[np.ndarray, "bend 3"]:
        """The same motion with a corner wherever the object's way has one.

        Args:
            corners: of a motion along the way.

        Returns:
            More corners, on the same straight lines.
        """
        found = [corners[:1]]
        for start, end in itertools.pairwise(corners):
            low, high = sorted((start[0], end[0]))
            passed = self.distance[(self.distance > low) & (self.distance < high)]
            share = np.sort((passed - start[0]) / (end[0] - start[0] or 1.0))
            found.append(start[None] + share[:, None] * (end - start)[None])
            found.append(end[None])
        return np.concatenate(found)
