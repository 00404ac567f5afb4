"""A scene that the robot with an arm is in: where its bodies, joints and grasp are."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.checked_input import real_array
from boomdp_jax.envs.mobile_arm import ARM_BODIES, MobileArm
from boomdp_jax.physics.params import Params, Weld
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict
from boomdp_jax.physics.state import State

_TIME_STEP = 0.02
# Angles of 32 bit may be this far beyond a limit that they are at [rad].
_ROUNDING = 1e-6


@dataclasses.dataclass(frozen=True, eq=False)
class ArmScene:
    """A scene with the bodies and joints of a `MobileArm` among others, host side.

    Raises:
        ValueError: one of the robot's bodies or joints is not in the scene.
    """

    robot: MobileArm
    spec: SceneSpec

    def __post_init__(self) -> None:
        if len(self.motors) != len(ARM_BODIES) - 1:
            raise ValueError(
                f"{self.spec.source}: constraints: expected the joints of "
                f"MobileArm.constraints(), got {len(self.motors)} of them"
            )

    @functools.cached_property
    def bodies(self) -> tuple[int, ...]:
        """Indices of base, upper arm and forearm."""
        return tuple(self.spec.index(name) for name in ARM_BODIES)

    @functools.cached_property
    def motors(self) -> tuple[int, ...]:
        """Revolute slots of shoulder and elbow."""
        pins = [c for c in self.spec.constraints if c.kind == "revolute"]
        ends = [(pin.body_a, pin.body_b) for pin in pins]
        base, upper_arm, forearm = self.bodies
        wanted = ((upper_arm, base), (forearm, upper_arm))
        return tuple(ends.index(pair) for pair in wanted if pair in ends)

    @property
    def others(self) -> tuple[int, ...]:
        """Indices of all bodies that are not the robot's."""
        return tuple(i for i in range(self.spec.num_bodies) if i not in self.bodies)

    @property
    def scene(self) -> Scene:
        """Arrays of `spec`."""
        return self.spec.scene

    def params(self) -> Params:
        """What the scene's file says, with an open grasp: the last weld slot."""
        return with_open_grasp(self.spec.params(), self.bodies[-1])

    def state(self, configuration: Float[np.ndarray, "5"]) -> State:
        """All bodies where the scene has them, the robot at rest in a configuration.

        Args:
            configuration: q [m, m, rad, rad, rad].

        Returns:
            The state.
        """
        start = self.spec.initial_state()
        poses = self.robot.body_poses(jnp.asarray(configuration, float))
        bodies = np.array(self.bodies)
        return State(
            start.pose.at[bodies].set(poses),
            start.twist.at[bodies].set(0.0),
        )

    def configuration(self, state: State) -> Float[Array, "5"]:
        """Configuration of the robot; angles as the state has them, not wrapped.

        Args:
            state: of all bodies.

        Returns:
            q [m, m, rad, rad, rad].
        """
        return _coordinates(state.pose[jnp.array(self.bodies)])

    def rates(self, state: State) -> Float[Array, "5"]:
        """Rates of the configuration.

        Args:
            state: of all bodies.

        Returns:
            [m/s, m/s, rad/s, rad/s, rad/s].
        """
        return _coordinates(state.twist[jnp.array(self.bodies)])


def arm_scene(
    robot: MobileArm,
    configuration: Float[np.ndarray, "5"],
    bodies: Sequence[dict],
    constraints: Sequence[dict] = (),
    *,
    dt: float = _TIME_STEP,
    source: str = "arm scene",
) -> ArmScene:
    """Put the robot into a room seen from above.

    Args:
        robot: its measures.
        configuration: where it starts [m, m, rad, rad, rad].
        bodies: walls and furniture, as in a scene file.
        constraints: of these, as in a scene file.
        dt: length of a step [s].
        source: name of the scene, for messages.

    Returns:
        The scene; the robot's bodies come first.

    Raises:
        ValueError: not five finite numbers, an angle beyond the joint's limit, or what
            is no scene.
    """
    _check_configuration(robot, configuration)
    content = {
        "schema": "planar-scene-1",
        "gravity": [0.0, 0.0],
        "dt": dt,
        "bodies": [*robot.bodies(configuration), *bodies],
        "constraints": [*robot.constraints(), *constraints],
    }
    return ArmScene(robot, scene_spec_from_dict(content, source))


def _check_configuration(robot: MobileArm, configuration: Any) -> None:
    numbers = real_array("configuration", configuration)
    if numbers.shape != (5,) or not np.all(np.isfinite(numbers)):
        raise ValueError(
            f"configuration: expected five finite numbers, got {numbers.tolist()}"
        )
    joints = zip(("shoulder", "elbow"), numbers[3:], robot.joint_limit, strict=True)
    for joint, angle, limit in joints:
        if abs(angle) > limit + _ROUNDING:
            raise ValueError(
                f"configuration: expected an angle of the {joint} within {limit:g} rad "
                f"to either side, got {angle:g}"
            )


def with_open_grasp(params: Params, forearm: int) -> Params:
    """Add an inactive weld slot, in which a grasp will be data (`grasp`).

    Args:
        params: one hypothesis.
        forearm: index of the body that the gripper is the end of.

    Returns:
        The same, one weld slot longer.
    """
    slot = Weld(
        active=on_device([False], bool),
        body_a=on_device([forearm], np.dtype(np.int32)),
        body_b=on_device([forearm], np.dtype(np.int32)),
        anchor_a=on_device(np.zeros((1, 2))),
        anchor_b=on_device(np.zeros((1, 2))),
        angle=on_device(np.zeros(1)),
    )
    if params.weld is None:
        return dataclasses.replace(params, weld=slot)
    joined = {
        field.name: jnp.concatenate(
            [getattr(params.weld, field.name), getattr(slot, field.name)]
        )
        for field in dataclasses.fields(Weld)
    }
    return dataclasses.replace(params, weld=Weld(**joined))


def _coordinates(rows: Float[Array, "3 3"]) -> Float[Array, "5"]:
    """Of poses, a configuration; of twists, its rates."""
    angles = rows[:, 2]
    return jnp.concatenate([rows[0], angles[1:] - angles[:-1]])
