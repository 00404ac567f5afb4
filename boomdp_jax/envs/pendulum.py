"""A bob on an arm, too heavy to be lifted by the forces at hand: it has to be swung.

After Scholz, Levihn and Isbell, What Does Physics Bias, section 5: forces round the
unit circle on the bob, chosen too weak for a direct swing-up; the reward is minus the
angle from upright in radians; a learner without physics sees x, y and their rates.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, Key
from boomdp_jax.core.checked_input import whole_number
from boomdp_jax.envs.action_set import forces_round_circle
from boomdp_jax.envs.environment import (
    AbstractEnvironment,
    EnvParams,
    PlanningHints,
    uniform_near,
)
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict
from boomdp_jax.physics.state import State

LENGTH, RADIUS, DENSITY, GRAVITY = 0.6, 0.05, 100.0, 9.81
FORCE_SHARE = 0.35
"""Force, as a part of the bob's weight."""
_TIME_STEP, _NUM_STEPS = 0.04, 300
_LEAF_STEPS = 10.0


def pendulum_scene(*, is_known: bool) -> SceneSpec:
    """The bob's scene; unknown: its density, and whether and where it is held."""
    bob = {
        "name": "bob",
        "pose": [0.0, -LENGTH, 0.0],
        "shape": {"type": "circle", "radius": RADIUS},
        "density": DENSITY if is_known else None,
    }
    pin = {
        "type": "revolute",
        "a": "bob",
        "b": "world",
        "anchor_a": [0.0, LENGTH],
        "anchor_b": [0.0, 0.0],
    }
    more = {"constraints": [pin]} if is_known else {"unknown": {"revolute": 1}}
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, -GRAVITY],
            "dt": _TIME_STEP,
            # This world is the engine's: whoever infers from it is to step alike.
            "substeps": 2,
            "bodies": [bob],
            **more,
        },
        "pendulum",
    )


class Pendulum(AbstractEnvironment):
    """Swing a bob up and keep it there; `start_spread`: of angle and spin."""

    def __init__(self, *, num_steps: int = _NUM_STEPS):
        """Pose the task for so many steps an episode."""
        self.name = "pendulum"
        self.spec = pendulum_scene(is_known=False)
        weight = DENSITY * np.pi * RADIUS**2 * GRAVITY
        self.actions = forces_round_circle(1, 0, FORCE_SHARE * weight, 8)
        self.num_steps = whole_number("num_steps", num_steps, 1)
        self.hints = PlanningHints(
            cell_size=(0.1, 0.3),
            stratum_size=(0.4, 1.2),
            depth=8,
            action_repeat=4,
            capacity=12,
        )

    def default_params(self) -> EnvParams:
        """Starts anywhere on the circle, with a spin of up to 1 rad/s."""
        return EnvParams(
            physics=pendulum_scene(is_known=True).params(),
            goal=jnp.array([[0.0, LENGTH, jnp.pi]], float),
            start=jnp.zeros((1, 3), float),
            start_spread=jnp.array([[0.0, jnp.pi, 1.0]], float),
        )

    def start(self, key: Key, params: EnvParams) -> State:
        """Draw an angle from hanging and a spin; the arm holds the bob."""
        drawn = uniform_near(key, params.start[0], params.start_spread[0])
        angle, spin = drawn[1], drawn[2]
        pin = params.physics.revolute
        pivot, arm = pin.anchor_b[0], pin.anchor_a[0]
        c, s = jnp.cos(angle), jnp.sin(angle)
        lever = jnp.stack([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]])
        velocity = spin * jnp.stack([lever[1], -lever[0]])
        return State(
            jnp.append(pivot - lever, angle)[None], jnp.append(velocity, spin)[None]
        )

    def reward(
        self,
        state: State,
        wrench: Float[Array, "body 3"],
        next_state: State,
        goal: Float[Array, "body 3"],
    ) -> FloatScalar:
        """Minus the angle from upright [rad], by where the bob is seen."""
        return -angle_from_upright(next_state)

    def is_solved(self, state: State, goal: Float[Array, "body 3"]) -> BoolScalar:
        """Never: upright has to be kept."""
        return jnp.zeros((), bool)

    def leaf_value(self, state: State, goal: Float[Array, "body 3"]) -> FloatScalar:
        """As if the bob stayed for ten steps."""
        return -_LEAF_STEPS * angle_from_upright(state)

    def coordinates(self, state: State) -> Float[Array, " coordinate"]:
        """Angle and spin about the pivot at the origin, by place and velocity."""
        x, y = state.pose[0, 0], state.pose[0, 1]
        vx, vy = state.twist[0, 0], state.twist[0, 1]
        square = jnp.maximum(x * x + y * y, 1e-6)
        return jnp.stack([jnp.arctan2(x, -y), (x * vy - y * vx) / square])

    def observe(self, state: State) -> Float[Array, " number"]:
        """x, y and their rates [m, m/s]."""
        return jnp.concatenate([state.pose[0, :2], state.twist[0, :2]])


def angle_from_upright(state: State) -> FloatScalar:
    """How far the bob is from upright [rad], by its place about the pivot."""
    x, y = state.pose[0, 0], state.pose[0, 1]
    return jnp.abs(jnp.arctan2(x, y))
