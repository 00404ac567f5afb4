r"""A robot of the engine's own bodies: a mobile base, a two-link arm, a gripper.

The base is a disc that a bounded force and torque drive in every direction; upper arm
and forearm are boxes on revolute joints with limits and motors; the gripper is the end
of the forearm (`grasp`). All lie in the plane of the furniture, and collide with it.

A configuration is $q = (x, y, \psi, \phi_1, \phi_2)$: pose of the base, angle of the
upper arm to the base, and of the forearm to the upper arm. With $e(\alpha)$ the unit
vector at an angle, the shoulder is at $(x, y) + s\,e(\psi)$, the elbow $l_1
e(\psi + \phi_1)$ further, the gripper $l_2 e(\psi + \phi_1 + \phi_2)$ from there.
"""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

ARM_BODIES = ("robot base", "robot upper arm", "robot forearm")
"""Names of its bodies in a scene, in the order of `MobileArm.body_poses`."""

_SURFACE = {"friction": 0.3, "restitution": 0.0}
# Below this the elbow's cosine counts as reached although rounding puts it beyond one.
_ROUNDING = 1e-9


@dataclasses.dataclass(frozen=True)
class MobileArm:
    """Measures and strengths of the robot, host side; compared by value.

    The shoulder's limit keeps the upper arm off the base. The forearm could reach the
    base; contact stops it, and planners keep it away (`ArmClearance`).

    Raises:
        ValueError: a number that is not positive, or a shoulder's limit at which the
            upper arm overlaps the base.
    """

    base_radius: float = 0.25
    """[m]"""
    shoulder: float = 0.3
    """Of the shoulder from the middle of the base, straight ahead [m]."""
    upper_arm: float = 0.4
    """From shoulder to elbow [m]."""
    forearm: float = 0.4
    """From elbow to gripper [m]."""
    half_width: float = 0.03
    """Of both links [m]."""
    shoulder_limit: float = 1.9
    """Largest angle to either side [rad]."""
    elbow_limit: float = 2.6
    """Largest angle to either side [rad]."""
    base_mass: float = 40.0
    """[kg]"""
    link_mass: float = 3.0
    """Of each link [kg]."""
    base_force: float = 300.0
    """Largest [N]."""
    base_torque: float = 100.0
    """Largest [N m]."""
    arm_torque: float = 80.0
    """Largest of each motor [N m]."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            number = getattr(self, field.name)
            if not (math.isfinite(number) and number > 0.0):
                raise ValueError(
                    f"MobileArm: {field.name}: expected a finite number above 0, "
                    f"got {number!r}"
                )
        # The middle of the base in the frame of the upper arm at the end of its range.
        along = -self.shoulder * math.cos(self.shoulder_limit)
        across = self.shoulder * math.sin(min(self.shoulder_limit, math.pi))
        gap = math.hypot(
            max(-along, along - self.upper_arm, 0.0),
            max(abs(across) - self.half_width, 0.0),
        )
        if gap < self.base_radius:
            raise ValueError(
                "MobileArm: shoulder_limit: expected one that keeps the upper arm off "
                f"the base ({self.base_radius:g} m), got {self.shoulder_limit:g} rad "
                f"({gap:.3g} m)"
            )

    @property
    def joint_limit(self) -> Float[np.ndarray, "2"]:
        """Largest angles of shoulder and elbow, to either side [rad]."""
        return np.array([self.shoulder_limit, self.elbow_limit])

    @property
    def mass(self) -> float:
        """Of all its bodies [kg]."""
        return self.base_mass + 2.0 * self.link_mass

    @property
    def reach(self) -> float:
        """Largest distance of any point of it from the middle of its base [m]."""
        length = self.shoulder + self.upper_arm + self.forearm
        return math.hypot(length, self.half_width)

    @property
    def levers(self) -> Float[np.ndarray, "5"]:
        """How far the point that moves most moves for a change of each coordinate.

        No point of the robot moves further than the sum of these times the sizes of
        the changes [m, m/rad].
        """
        links = math.hypot(self.upper_arm + self.forearm, self.half_width)
        forearm = math.hypot(self.forearm, self.half_width)
        return np.array([1.0, 1.0, self.reach, links, forearm])

    def body_poses(self, configuration: Float[Array, "5"]) -> Float[Array, "3 3"]:
        """Where its bodies are: base, upper arm, forearm.

        Args:
            configuration: q [m, m, rad, rad, rad].

        Returns:
            Poses of the centres of mass [m, m, rad].
        """
        base, angle, tip, elbow = self._links(configuration)
        shoulder = elbow - self.upper_arm * _unit(angle)
        gripper_angle = angle + configuration[4]
        poses = [
            jnp.append(base, configuration[2]),
            jnp.append(0.5 * (shoulder + elbow), angle),
            jnp.append(0.5 * (elbow + tip), gripper_angle),
        ]
        return jnp.stack(poses)

    def gripper(self, configuration: Float[Array, "5"]) -> Float[Array, "3"]:
        """Where the gripper is, and which way it points.

        Args:
            configuration: q [m, m, rad, rad, rad].

        Returns:
            Position and angle of the forearm [m, m, rad].
        """
        _, angle, tip, _ = self._links(configuration)
        return jnp.append(tip, angle + configuration[4])

    def _links(self, configuration: Float[Array, "5"]) -> tuple:
        base, heading = configuration[:2], configuration[2]
        angle = heading + configuration[3]
        elbow = base + self.shoulder * _unit(heading) + self.upper_arm * _unit(angle)
        tip = elbow + self.forearm * _unit(angle + configuration[4])
        return base, angle, tip, elbow

    def arm_angles(
        self, base: Float[Array, "3"], point: Float[Array, "2"]
    ) -> tuple[Float[Array, "2 2"], Bool[Array, "2"]]:
        r"""Angles at which the gripper of a base that stands is at a point.

        With d the vector from shoulder to point in the frame of the base, $\cos\phi_2 =
        (d^2 - l_1^2 - l_2^2) / 2 l_1 l_2$ and $\phi_1 = \arg d - \arg(l_1 +
        l_2 e(\phi_2))$.

        Args:
            base: pose of the base [m, m, rad].
            point: in the world [m].

        Returns:
            Shoulder and elbow, with the elbow bent to the left and to the right [rad],
            and whether the arm is long enough and its joints turn that far; angles of
            a point out of reach are those of the arm stretched, or folded, towards it.
        """
        cos, sin = jnp.cos(base[2]), jnp.sin(base[2])
        away = point - base[:2]
        dx = cos * away[0] + sin * away[1] - self.shoulder
        dy = cos * away[1] - sin * away[0]
        square = dx**2 + dy**2
        lengths = self.upper_arm**2 + self.forearm**2
        bend = (square - lengths) / (2.0 * self.upper_arm * self.forearm)
        elbow = jnp.arccos(jnp.clip(bend, -1.0, 1.0)) * jnp.array([1.0, -1.0])
        inner = jnp.arctan2(
            self.forearm * jnp.sin(elbow),
            self.upper_arm + self.forearm * jnp.cos(elbow),
        )
        shoulder = _wrapped(jnp.arctan2(dy, dx) - inner)
        angles = jnp.stack([shoulder, elbow], axis=-1)
        is_long_enough = jnp.abs(bend) <= 1.0 + _ROUNDING
        within = jnp.all(jnp.abs(angles) <= self.joint_limit[None], axis=-1)
        return angles, within & is_long_enough

    def around_gripper(
        self, gripper: Float[Array, "3"], angles: Float[Array, "2"]
    ) -> Float[Array, "5"]:
        """Configuration of a gripper's pose and of the arm's angles; there is one.

        Args:
            gripper: position and angle [m, m, rad].
            angles: of shoulder and elbow [rad].

        Returns:
            The configuration, its heading not wrapped.
        """
        elbow = gripper[:2] - self.forearm * _unit(gripper[2])
        upper = gripper[2] - angles[1]
        heading = upper - angles[0]
        base = elbow - self.upper_arm * _unit(upper) - self.shoulder * _unit(heading)
        return jnp.concatenate([base, heading[None], angles])

    def bodies(self, configuration: Float[np.ndarray, "5"]) -> list[dict]:
        """Its bodies, for the list `bodies` of a scene file.

        Args:
            configuration: where it starts [m, m, rad, rad, rad].

        Returns:
            Base, upper arm and forearm.
        """
        poses = np.asarray(self.body_poses(jnp.asarray(configuration, float)))
        lengths = (self.upper_arm, self.forearm)
        shapes: list[dict] = [{"type": "circle", "radius": self.base_radius}]
        shapes += [
            {"type": "box", "half_extents": [0.5 * length, self.half_width]}
            for length in lengths
        ]
        areas = [math.pi * self.base_radius**2]
        areas += [2.0 * length * self.half_width for length in lengths]
        masses = (self.base_mass, self.link_mass, self.link_mass)
        return [
            {
                "name": name,
                "pose": pose.tolist(),
                "shape": shape,
                "density": mass / area,
                "contact": dict(_SURFACE),
            }
            for name, pose, shape, mass, area in zip(
                ARM_BODIES, poses, shapes, masses, areas, strict=True
            )
        ]

    def constraints(self) -> list[dict]:
        """Its joints, for the list `constraints` of a scene file; motors at rest."""
        starts = (self.shoulder, 0.5 * self.upper_arm)
        lengths = (self.upper_arm, self.forearm)
        return [
            {
                "type": "revolute",
                "a": ARM_BODIES[joint + 1],
                "b": ARM_BODIES[joint],
                "anchor_a": [-0.5 * lengths[joint], 0.0],
                "anchor_b": [starts[joint], 0.0],
                "lower": -float(self.joint_limit[joint]),
                "upper": float(self.joint_limit[joint]),
                "motor_speed": 0.0,
                "motor_torque": self.arm_torque,
            }
            for joint in range(2)
        ]


def _unit(angle: Float[Array, ""]) -> Float[Array, "2"]:
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def _wrapped(angle: Float[Array, "2"]) -> Float[Array, "2"]:
    return (angle + jnp.pi) % (2.0 * jnp.pi) - jnp.pi
