"""How much room the robot with an arm has in a configuration, held object and all.

Every body of the robot is measured against every other body of the scene where that
stands, the forearm against the base, and an object that is held, where the gripper has
it, against all but the forearm. Configurations are measured in blocks, by one compiled
function for each scene.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.core.arrays import on_device
from boomdp_jax.envs.arm_scene import ArmScene
from boomdp_jax.envs.mobile_arm import MobileArm
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.separation import pair_separation
from boomdp_jax.physics.state import State

_BLOCK = 32
"""Configurations that are measured at once."""


class Held(NamedTuple):
    """An object in the gripper."""

    body: int
    pose: Float[np.ndarray, "3"]
    """In the frame of the gripper [m, m, rad]."""


@dataclasses.dataclass(frozen=True, eq=False)
class ArmClearance:
    """Measures configurations in one arrangement of a scene's other bodies.

    Raises:
        ValueError: an object that cannot be held.
    """

    world: ArmScene
    pose: Float[np.ndarray, "body 3"]
    """Where all bodies are; those of the robot and a held one are ignored."""
    held: Held | None = None

    def __post_init__(self) -> None:
        if self.held is not None and self.held.body not in self._movable:
            raise ValueError(
                f"held: body: expected one of {self._movable}, got {self.held.body}"
            )

    @property
    def _movable(self) -> tuple[int, ...]:
        is_static = self.world.spec.is_static
        return tuple(i for i in self.world.others if not is_static[i])

    @functools.cached_property
    def pairs(self) -> Int[np.ndarray, "pair 2"]:
        """Bodies that are measured against each other."""
        base, upper_arm, forearm = self.world.bodies
        others = [
            i for i in self.world.others if self.held is None or i != self.held.body
        ]
        pairs = [(own, i) for own in self.world.bodies for i in others]
        pairs.append((base, forearm))
        if self.held is not None:
            pairs += [(self.held.body, i) for i in (base, upper_arm, *others)]
        return np.array(pairs, np.int32)

    @functools.cached_property
    def _fixed(self) -> tuple:
        """Arrays that are the same for all configurations."""
        body, grip = (-1, np.zeros(3)) if self.held is None else self.held
        return (
            self.world.scene,
            on_device(self.world.bodies, np.dtype(np.int32)),
            on_device(self.pose),
            on_device(body, np.dtype(np.int32)),
            on_device(grip),
            on_device(self.pairs, np.dtype(np.int32)),
        )

    def clearance(
        self, configurations: Float[np.ndarray, "point 5"]
    ) -> Float[np.ndarray, "point pair"]:
        """Distances of all `pairs`, negative where two overlap.

        Args:
            configurations: q [m, m, rad, rad, rad].

        Returns:
            [m].
        """
        return in_blocks(
            lambda block: _measured(self.world.robot, *self._fixed, block),
            configurations,
        )

    def is_free(
        self,
        configurations: Float[np.ndarray, "point 5"],
        margin: float | Float[np.ndarray, " pair"] = 0.0,
    ) -> Bool[np.ndarray, " point"]:
        """Whether joints are within their ranges and every pair is clear.

        Args:
            configurations: q [m, m, rad, rad, rad].
            margin: room that pairs need, one number or one for each of `pairs` [m].

        Returns:
            One answer each.
        """
        limit = self.world.robot.joint_limit
        within = np.all(np.abs(configurations[:, 3:]) <= limit, axis=1)
        return within & np.all(self.clearance(configurations) > margin, axis=1)


def in_blocks(
    function: Callable[..., Array], *rows: Float[np.ndarray, "point _"]
) -> Float[np.ndarray, "point _"]:
    """Apply a compiled function to many rows, always to as many at once.

    Args:
        function: from as many blocks of rows as there are `rows` to one array.
        rows: numbers of each point.

    Returns:
        The results, one after another.
    """
    num = len(rows[0])
    short = -num % _BLOCK if num else _BLOCK
    padded = [np.pad(part, ((0, short), (0, 0))) for part in rows]
    found = [
        np.asarray(function(*(on_device(p[i : i + _BLOCK]) for p in padded)))
        for i in range(0, num + short, _BLOCK)
    ]
    return np.concatenate(found)[:num]


@functools.partial(jax.jit, static_argnums=0)
def _measured(
    robot: MobileArm,
    scene: Scene,
    bodies: Int[Array, "3"],
    pose: Float[Array, "body 3"],
    held: Int[Array, ""],
    grip: Float[Array, "3"],
    pairs: Int[Array, "pair 2"],
    configurations: Float[Array, "point 5"],
) -> Float[Array, "point pair"]:
    def of_one(configuration):
        placed = pose.at[bodies].set(robot.body_poses(configuration))
        carried = compose(robot.gripper(configuration), grip)
        # An index of -1 is the last body; what was there is put back.
        row = jnp.where(held >= 0, carried, placed[held])
        state = State(placed.at[held].set(row), jnp.zeros_like(placed))
        return jax.vmap(lambda pair: pair_separation(scene, state, pair[0], pair[1]))(
            pairs
        )

    return jax.vmap(of_one)(configurations)


def compose(frame: Float[Array, "3"], pose: Float[Array, "3"]) -> Float[Array, "3"]:
    """A pose that is given in a frame, in the world [m, m, rad]."""
    cos, sin = jnp.cos(frame[2]), jnp.sin(frame[2])
    x = frame[0] + cos * pose[0] - sin * pose[1]
    y = frame[1] + sin * pose[0] + cos * pose[1]
    return jnp.stack([x, y, frame[2] + pose[2]])


def relative(frame: np.ndarray, pose: np.ndarray) -> Float[np.ndarray, "3"]:
    """A pose of the world, in a frame [m, m, rad]; the inverse of `compose`."""
    cos, sin = math.cos(frame[2]), math.sin(frame[2])
    x, y = pose[0] - frame[0], pose[1] - frame[1]
    return np.array([cos * x + sin * y, cos * y - sin * x, pose[2] - frame[2]])
