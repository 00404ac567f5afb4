"""A shopping cart on fixed wheels, in a room whose middle wall hides the goal.

After Scholz et al. (2014), A Physics-Based Model Prior for Object-Oriented MDPs, with
the room, the cart and its way measured from their pictures, a pixel being a centimetre:
the straight way is 3.5 m, the way round the wall about twice that. Both fixed wheels at
the handle act as one contact, which rolls along the cart and hardly slips across it.
Forces push the centre of mass; walls stop the cart (`walls`). The episode is solved,
and costs nothing any more, within `GOAL_RADIUS` of the goal. In other worlds than the
papers' the truth differs from what agents are told (`cart_worlds`).
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, Key
from boomdp_jax.core.checked_input import whole_number
from boomdp_jax.envs.action_set import forces_round_circle
from boomdp_jax.envs.cart_worlds import CartWorld, Corners, cart_world_of
from boomdp_jax.envs.environment import (
    AbstractEnvironment,
    EnvParams,
    PlanningHints,
    distance,
    uniform_near,
    wrapped,
)
from boomdp_jax.envs.walls import (
    outline_of,
    stopped_at_walls,
    wall_separation,
    walls_between,
)
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict
from boomdp_jax.physics.state import State
from boomdp_jax.physics.step import rollout, step

CART_OUTLINE: Corners = ((-0.65, -0.385), (0.66, -0.29), (0.66, 0.29), (-0.65, 0.385))
"""Corners [m]: the handle's end is the wider one."""
ROOM = (
    (-1.0, -1.0, 0.06, 5.8),
    (6.34, -1.0, 7.4, 5.8),
    (-1.0, -1.0, 7.4, 0.06),
    (-1.0, 4.74, 7.4, 5.8),
    (3.13, 0.0, 3.26, 2.88),
    (3.13, 4.32, 3.26, 4.79),
    (0.0, 2.35, 0.64, 2.45),
    (2.56, 2.35, 3.84, 2.45),
    (5.76, 2.35, 6.4, 2.45),
)
"""Walls: least x and y, greatest x and y [m]."""
START, GOAL, GOAL_RADIUS = (1.75, 1.34, 0.4), (5.28, 1.38), 0.3
DENSITY, FORCE = 10.0, 30.0
AXLE = -0.5
"""Place of the wheels along the cart [m]."""
VISCOUS_PRIOR = {
    "wheel.lateral_limit": {"center": 100.0},
    "wheel.dry_ratio": {"center": 0.0},
    "wheel.half_track": {"center": 0.02},
}
"""Of the agent: wheels are those of the papers, one contact each that never slips dry.
The default prior expects a wheel to give way at half of the cart's weight; next to it
this world's law is hardly possible, and its axle was found 9 cm off."""
_TIME_STEP, _NUM_STEPS, _LEAF_STEPS = 0.4, 500, 10.0
_NEAR_WALL = 0.16
"""A cart this near a wall may have been stopped by it: stops come a quarter of a step's
way early [m]."""
_AT_REST = 0.1
"""No push leaves a free cart slower than this, in m/s and rad/s together."""


def cart_scene(*, is_known: bool, world: CartWorld | None = None) -> SceneSpec:
    """The cart's scene: the true one, or what an agent is told.

    Args:
        is_known: whether it is the true one; else density, and pins and wheels that
            the cart may have, are unknown.
        world: what differs between the two; default: nothing.

    Returns:
        The scene; a centre of mass elsewhere is not in it (`Cart.default_params`).
    """
    world = world or CartWorld()
    unknown = {"unknown": {"revolute": 1, "wheel": 1}, "prior": VISCOUS_PRIOR}
    known = {"constraints": [_wheel(world), *map(dict, world.more)]}
    outline = CART_OUTLINE if is_known else world.told(CART_OUTLINE)
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, 0.0],
            "dt": _TIME_STEP,
            # This world is the engine's, coarse as its steps are: whoever infers from
            # what happens in it is to step alike.
            "substeps": 2,
            "bodies": [
                {
                    "name": "cart",
                    "pose": list(START),
                    "shape": {
                        "type": "polygon",
                        "vertices": np.array(outline).tolist(),
                    },
                    "density": DENSITY if is_known else None,
                }
            ],
            **(known if is_known else unknown),
        },
        "cart",
    )


def _wheel(world: CartWorld) -> dict[str, Any]:
    """Both of the cart's fixed wheels as one constraint."""
    return {"type": "wheel", "a": "cart", "pose": [AXLE, 0.0, 0.0], **world.wheel}


def _walled_scene() -> SceneSpec:
    """The cart on its wheels and, as static boxes, the walls: for pictures."""
    walls = walls_between(np.array(ROOM))
    boxes = [
        {
            "name": f"wall {index}",
            "static": True,
            "pose": [*middle, 0.0],
            "shape": {"type": "box", "half_extents": half},
        }
        for index, (middle, half) in enumerate(
            zip(walls.middle.tolist(), walls.half_extents.tolist(), strict=True)
        )
    ]
    cart = {
        "name": "cart",
        "pose": list(START),
        "shape": {"type": "polygon", "vertices": np.array(CART_OUTLINE).tolist()},
        "density": DENSITY,
    }
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, 0.0],
            "dt": _TIME_STEP,
            "bodies": [cart, *boxes],
            "constraints": [_wheel(CartWorld())],
        },
        "cart among walls",
    )


class Cart(AbstractEnvironment):
    """Push a cart round a wall; `start_spread`: of its pose."""

    def __init__(self, *, num_steps: int = _NUM_STEPS, world: str = "as-told"):
        """Pose the task.

        Args:
            num_steps: of an episode.
            world: what is true, one of `CART_WORLDS`.

        Raises:
            ValueError: no such world.
        """
        self.name = "cart"
        self._world = cart_world_of(world)
        self.spec = cart_scene(is_known=False, world=self._world)
        self._truth = cart_scene(is_known=True, world=self._world)
        self.actions = forces_round_circle(1, 0, FORCE, 8, with_nothing=False)
        self.num_steps = whole_number("num_steps", num_steps, 1)
        self.hints = PlanningHints(
            cell_size=(0.25, 0.25, 0.8),
            stratum_size=(1.0, 1.0, np.inf),
            depth=14,
            action_repeat=2,
            capacity=16,
        )
        self.walls = walls_between(np.array(ROOM))
        # The engine's outline: about the centre of mass.
        self.outline, self.true_outline = (
            outline_of(np.asarray(spec.scene.vertices[0], float))
            for spec in (self.spec, self._truth)
        )

    @property
    def seen_spec(self) -> SceneSpec:
        """The cart among its walls."""
        return _walled_scene()

    @property
    def surroundings(self) -> tuple[Scene, Float[Array, "other 3"]]:
        """The cart among its walls, and where these are."""
        with jax.ensure_compile_time_eval():
            middle = self.walls.middle
            pose = jnp.concatenate([middle, jnp.zeros_like(middle[:, :1])], axis=1)
            return self.seen_spec.scene, pose

    def default_params(self) -> EnvParams:
        """Starts within a quarter of a metre and in any direction."""
        physics = self._truth.params()
        if self._world.center_of_mass is not None:
            center = jnp.array([self._world.center_of_mass], float)
            physics = dataclasses.replace(physics, center_of_mass=center)
        return EnvParams(
            physics=physics,
            goal=jnp.array([[*GOAL, 0.0]], float),
            start=jnp.array([START], float),
            start_spread=jnp.array([[0.2, 0.2, jnp.pi]], float),
        )

    def start(self, key: Key, params: EnvParams) -> State:
        """Draw a pose, at rest; moved to the middle as far as walls are in the way."""
        middle = params.start[0]
        pose = uniform_near(key, middle, params.start_spread[0])
        turned = pose.at[:2].set(middle[:2])
        parts = jnp.linspace(1.0, 0.0, 6, dtype=pose.dtype)
        poses = turned[None] + parts[:, None] * (pose - turned)[None]
        is_clear = jax.vmap(
            lambda p: wall_separation(self.walls, self.true_outline, p) > 0
        )(poses)
        return State(poses[jnp.argmax(is_clear)][None], jnp.zeros((1, 3), pose.dtype))

    def advance(
        self, physics: Params, state: State, wrench: Float[Array, "body 3"]
    ) -> State:
        """One step of the engine, or as far as walls let the cart go."""
        return self.halted(state, step(self.scene, physics, state, wrench)[0])

    def halted(self, state: State, next_state: State) -> State:
        """As far as walls let the cart go, by the outline that is told."""
        return stopped_at_walls(self.walls, self.outline, state, next_state)

    def happens(
        self, physics: Params, state: State, wrench: Float[Array, "body 3"]
    ) -> State:
        """The same with the true outline."""
        with jax.ensure_compile_time_eval():
            scene = self._truth.scene
        num = self._world.num_parts
        wrenches = jnp.broadcast_to(wrench[None], (num, *wrench.shape))
        states, _ = rollout(scene, physics, state, wrenches, dt=scene.dt / num)
        moved = jax.tree.map(lambda leaf: leaf[-1], states)
        return stopped_at_walls(self.walls, self.true_outline, state, moved)

    def reward(
        self,
        state: State,
        wrench: Float[Array, "body 3"],
        next_state: State,
        goal: Float[Array, "body 3"],
    ) -> FloatScalar:
        """Minus the distance to the goal [m], nothing once it is reached."""
        away = distance(next_state.pose[0, :2], goal[0, :2])
        return jnp.where(away < GOAL_RADIUS, 0.0, -away)

    def is_solved(self, state: State, goal: Float[Array, "body 3"]) -> BoolScalar:
        """Within the goal's radius."""
        return distance(state.pose[0, :2], goal[0, :2]) < GOAL_RADIUS

    def leaf_value(self, state: State, goal: Float[Array, "body 3"]) -> FloatScalar:
        """The straight distance for ten steps more, as if there were no walls."""
        return -_LEAF_STEPS * distance(state.pose[0, :2], goal[0, :2])

    def coordinates(self, state: State) -> Float[Array, " coordinate"]:
        """The pose: velocities fade within a step."""
        return state.pose[0].at[2].set(wrapped(state.pose[0, 2]))

    def observe(self, state: State) -> Float[Array, " number"]:
        """Pose and twist."""
        return jnp.concatenate([state.pose[0], state.twist[0]])

    def moved_freely(self, state: State, next_state: State) -> Bool[Array, " body"]:
        """Whether the cart was well clear of walls after the step, and on its way.

        A long arm can swing at a wall from afar, but who was stopped is at rest.
        """
        gap = wall_separation(self.walls, self.outline, next_state.pose[0])
        speed = jnp.sqrt(jnp.sum(next_state.twist[0] ** 2))
        return ((gap > _NEAR_WALL) & (speed > _AT_REST))[None]
