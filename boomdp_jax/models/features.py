r"""How a regression sees a body: what goes in, what comes out, in which frame.

What is learnt is the deviation from coasting, the motion at constant velocity that is
expected of a body of which nothing is known: with $\tilde v$ the twist,

$$y = (p' - p - h \tilde v, \; \tilde v' - \tilde v).$$

In the world frame the input is pose, twist and wrench. In the body frame (Scholz,
Levihn, Isbell and Wingate 2014, A physics-based model prior for object-oriented MDPs)
planar vectors are seen from the frame of the body before the step and the pose is
dropped, so that what was learnt in one place holds in all.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.envs.environment import wrapped
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State

FRAMES = ("world", "body")
"""Where planar vectors are seen from."""


class BodyFeatures(eqx.Module):
    """Numbers of each body that moves, as a regression takes and gives them.

    Without angles headings and spins are neither seen nor predicted (the papers'
    pendulum of four numbers), torques are not seen, and the body frame is not turned.
    """

    dt: FloatScalar
    """Length of a step [s]."""
    moving: tuple[int, ...] = eqx.field(static=True)
    """Which bodies are not static."""
    num_bodies: int = eqx.field(static=True)
    frame: str = eqx.field(static=True)
    has_angles: bool = eqx.field(static=True)

    def __init__(self, scene: Scene, *, frame: str = "body", angles: bool = True):
        """Of the bodies of one scene.

        Args:
            scene: what moves, and for how long a step.
            frame: `world` or `body`.
            angles: whether headings, spins and torques count.

        Raises:
            ValueError: another frame, a batch of scenes, or nothing that moves.
        """
        if frame not in FRAMES:
            raise ValueError(
                f"frame: expected one of {', '.join(FRAMES)}; got {frame!r}"
            )
        if scene.is_static.ndim != 1:
            raise ValueError(
                "scene: expected a single one, is_static of shape [body]; got shape "
                f"{scene.is_static.shape}"
            )
        self.moving = tuple(
            int(body) for body in np.flatnonzero(~np.asarray(scene.is_static))
        )
        if not self.moving:
            raise ValueError(
                "scene: expected a body that can move; got "
                f"{scene.num_bodies} static ones"
            )
        self.dt = jnp.asarray(scene.dt)
        self.num_bodies = scene.num_bodies
        self.frame = frame
        self.has_angles = angles

    @property
    def num_inputs(self) -> int:
        """Numbers a regression sees of a body."""
        num_moments = 2 if self.frame == "body" else 3
        return num_moments * self.num_outputs // 2

    @property
    def num_outputs(self) -> int:
        """Numbers it predicts of a body."""
        return 6 if self.has_angles else 4

    def inputs(
        self, state: State, wrench: Float[Array, "body 3"]
    ) -> Float[Array, "moving input"]:
        """What a regression sees.

        Args:
            state: of all bodies.
            wrench: on all bodies [N, N, N m].

        Returns:
            Pose (in the world frame only; the heading between −π and π), twist and
            wrench of each moving body, in the frame of these features.
        """
        index = np.array(self.moving)
        pose, twist = state.pose[index], state.twist[index]
        parts = [self._local(pose, twist), self._local(pose, wrench[index])]
        if self.frame == "world":
            parts.insert(0, pose.at[:, 2].set(wrapped(pose[:, 2])))
        return jnp.concatenate([self._chosen(part) for part in parts], axis=-1)

    def targets(self, state: State, next_state: State) -> Float[Array, "moving output"]:
        """What a regression should say.

        Args:
            state: before a step.
            next_state: after it; heading modulo a turn.

        Returns:
            Deviation from coasting of pose and twist of each moving body.
        """
        index = np.array(self.moving)
        pose, twist = state.pose[index], state.twist[index]
        shift = next_state.pose[index] - pose
        shift = shift.at[:, 2].set(wrapped(shift[:, 2])) - self.dt * twist
        change = next_state.twist[index] - twist
        parts = [self._local(pose, shift), self._local(pose, change)]
        return jnp.concatenate([self._chosen(part) for part in parts], axis=-1)

    def row(
        self, state: State, wrench: Float[Array, "body 3"], next_state: State
    ) -> tuple[
        Float[Array, "moving input"],
        Float[Array, "moving output"],
        Bool[Array, " moving"],
    ]:
        """What a regression learns from a step.

        Args:
            state: before it.
            wrench: held over it [N, N, N m].
            next_state: after it; not a number where it was not read.

        Returns:
            Inputs and targets, zero where they were not read, and of which moving
            bodies all of them were.
        """
        inputs, targets = self.inputs(state, wrench), self.targets(state, next_state)
        both = jnp.concatenate([inputs, targets], axis=-1)
        is_seen = jnp.all(jnp.isfinite(both), axis=-1)
        return jnp.nan_to_num(inputs), jnp.nan_to_num(targets), is_seen

    def next_state(self, state: State, outputs: Float[Array, "moving output"]) -> State:
        """Where bodies are after a step for which a regression says this.

        Args:
            state: before it.
            outputs: deviation from coasting of each moving body.

        Returns:
            The state; static bodies as they were, and without angles headings and
            spins as they were.
        """
        index = np.array(self.moving)
        pose, twist = state.pose[index], state.twist[index]
        half = self.num_outputs // 2
        shift, change = (
            self._turned(pose, self._filled(part), sign=1.0)
            for part in (outputs[:, :half], outputs[:, half:])
        )
        coast = twist if self.has_angles else twist.at[:, 2].set(0.0)
        shift = (shift + self.dt * coast).astype(pose.dtype)
        return State(
            pose=state.pose.at[index].add(shift),
            twist=state.twist.at[index].add(change.astype(twist.dtype)),
        )

    def _local(
        self, pose: Float[Array, "moving 3"], vector: Float[Array, "moving 3"]
    ) -> Float[Array, "moving 3"]:
        """Of vectors in the world frame."""
        return self._turned(pose, vector, sign=-1.0)

    def _turned(
        self,
        pose: Float[Array, "moving 3"],
        vector: Float[Array, "moving 3"],
        *,
        sign: float,
    ) -> Float[Array, "moving 3"]:
        """Into the frame of the features, or out of it."""
        if self.frame == "world" or not self.has_angles:
            return vector
        cos, sin = jnp.cos(pose[:, 2]), sign * jnp.sin(pose[:, 2])
        x, y, angle = vector[:, 0], vector[:, 1], vector[:, 2]
        return jnp.stack([cos * x - sin * y, sin * x + cos * y, angle], axis=-1)

    def _chosen(
        self, vector: Float[Array, "moving 3"]
    ) -> Float[Array, "moving number"]:
        """Without the angular number if that does not count."""
        return vector if self.has_angles else vector[:, :2]

    def _filled(self, vector: Float[Array, "moving number"]) -> Array:
        """With a zero for the angular number that does not count."""
        return vector if self.has_angles else jnp.pad(vector, ((0, 0), (0, 1)))
