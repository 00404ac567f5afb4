"""Two links that hang from a pivot, with a motor between them: swing the tip up.

After Sutton (1996), Generalization in Reinforcement Learning, section 4, with the true
dynamics of two boxes and the height of the tip as the cost. Where returns on a pendulum
hardly separate models, those on an acrobot do (Ramesh and Ravindran 2023).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, Key
from boomdp_jax.core.checked_input import whole_number
from boomdp_jax.envs.action_set import ActionSet
from boomdp_jax.envs.environment import (
    AbstractEnvironment,
    EnvParams,
    PlanningHints,
    uniform_near,
    wrapped,
)
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict
from boomdp_jax.physics.state import State

LINK, HALF_WIDTH, DENSITY, GRAVITY = 0.5, 0.03, 30.0, 9.81
TORQUE = 1.5
"""Of the motor between the links, either way [N m]."""
_TIME_STEP, _NUM_STEPS, _LEAF_STEPS = 0.05, 300, 10.0


def acrobot_scene(*, is_known: bool) -> SceneSpec:
    """The scene; unknown: densities, and how the links are tied."""

    def link(name: str, middle: float) -> dict:
        return {
            "name": name,
            "pose": [0.0, middle, 0.0],
            "shape": {"type": "box", "half_extents": [HALF_WIDTH, LINK / 2]},
            "density": DENSITY if is_known else None,
        }

    def pin(a: str, b: str, anchor_a: float, anchor_b: float) -> dict:
        anchors = {"anchor_a": [0.0, anchor_a], "anchor_b": [0.0, anchor_b]}
        return {"type": "revolute", "a": a, "b": b, **anchors}

    pins = [
        pin("upper", "world", LINK / 2, 0.0),
        pin("upper", "lower", -LINK / 2, LINK / 2),
    ]
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, -GRAVITY],
            "dt": _TIME_STEP,
            "bodies": [link("upper", -LINK / 2), link("lower", -1.5 * LINK)],
            **({"constraints": pins} if is_known else {"unknown": {"revolute": 2}}),
        },
        "acrobot",
    )


class Acrobot(AbstractEnvironment):
    """Swing two links up; `start_spread`: of their angles from hanging."""

    def __init__(self, *, num_steps: int = _NUM_STEPS):
        """Pose the task for so many steps an episode."""
        self.name = "acrobot"
        self.spec = acrobot_scene(is_known=False)
        turn = TORQUE * jnp.array([-1.0, 0.0, 1.0], float)
        wrench = jnp.zeros((3, 2, 3), float)
        wrench = wrench.at[:, 0, 2].set(-turn).at[:, 1, 2].set(turn)
        self.actions = ActionSet(wrench)
        self.num_steps = whole_number("num_steps", num_steps, 1)
        self.hints = PlanningHints(
            cell_size=(0.2, 0.2, 0.8, 0.8),
            stratum_size=(0.8, 0.8, 3.2, 3.2),
            depth=10,
            action_repeat=4,
            capacity=64,
        )

    def default_params(self) -> EnvParams:
        """Starts within 0.4 rad of hanging, at rest."""
        spread = jnp.zeros((2, 3), float).at[:, 2].set(0.4)
        return EnvParams(
            physics=acrobot_scene(is_known=True).params(),
            goal=jnp.array([[0.0, LINK / 2, jnp.pi], [0.0, 1.5 * LINK, jnp.pi]], float),
            start=jnp.zeros((2, 3), float),
            start_spread=spread,
        )

    def start(self, key: Key, params: EnvParams) -> State:
        """Draw the links' angles; pins tie them."""
        angles = uniform_near(key, params.start, params.start_spread)[:, 2]
        s, c = LINK * jnp.sin(angles), -LINK * jnp.cos(angles)
        places = jnp.stack(
            [
                jnp.stack([s[0] / 2, c[0] / 2, angles[0]]),
                jnp.stack([s[0] + s[1] / 2, c[0] + c[1] / 2, angles[1]]),
            ]
        )
        return State(places, jnp.zeros_like(places))

    def reward(
        self,
        state: State,
        wrench: Float[Array, "body 3"],
        next_state: State,
        goal: Float[Array, "body 3"],
    ) -> FloatScalar:
        """Minus how far the tip is below its highest place [m]."""
        return -tip_below_top(next_state)

    def is_solved(self, state: State, goal: Float[Array, "body 3"]) -> BoolScalar:
        """Never: the tip has to be kept up."""
        return jnp.zeros((), bool)

    def leaf_value(self, state: State, goal: Float[Array, "body 3"]) -> FloatScalar:
        """As if the tip stayed for ten steps."""
        return -_LEAF_STEPS * tip_below_top(state)

    def coordinates(self, state: State) -> Float[Array, " coordinate"]:
        """Angles and spins of both links."""
        return jnp.concatenate([wrapped(state.pose[:, 2]), state.twist[:, 2]])

    def observe(self, state: State) -> Float[Array, " number"]:
        """Cosines and sines of the links' angles, and their spins."""
        angle = state.pose[:, 2]
        return jnp.concatenate([jnp.cos(angle), jnp.sin(angle), state.twist[:, 2]])


def tip_below_top(state: State) -> FloatScalar:
    """How far the end of the lower link is below twice a link's length [m]."""
    return 2.0 * LINK + LINK * jnp.sum(jnp.cos(state.pose[:, 2]))
