"""A line of five places: the smallest task whose best return is known."""

import jax.numpy as jnp

from boomdp_jax.envs import (
    AbstractEnvironment,
    ActionSet,
    EnvParams,
    PlanningHints,
)
from boomdp_jax.physics import State, empty_params, scene_spec_from_dict

NUM_PLACES = 5


class LineWorld(AbstractEnvironment):
    """A body at a place from 0 to 4 goes left or right; its distance is its cost."""

    def __init__(self, num_steps=10):
        self.name = "line"
        self.spec = scene_spec_from_dict(
            {
                "schema": "planar-scene-1",
                "gravity": [0.0, 0.0],
                "dt": 1.0,
                "bodies": [
                    {
                        "name": "walker",
                        "pose": [0, 0, 0],
                        "shape": {"type": "circle", "radius": 0.1},
                        "density": 1.0,
                    }
                ],
            }
        )
        wrench = jnp.zeros((2, 1, 3)).at[:, 0, 0].set(jnp.array([-1.0, 1.0]))
        self.actions = ActionSet(wrench)
        self.num_steps = num_steps
        self.hints = PlanningHints((1.0,), (1.0,), depth=6, action_repeat=1, capacity=8)

    def default_params(self):
        goal = jnp.array([[NUM_PLACES - 1.0, 0.0, 0.0]])
        return EnvParams(empty_params(1), goal, jnp.zeros((1, 3)), jnp.zeros((1, 3)))

    def start(self, key, params):
        return State(params.start, jnp.zeros((1, 3)))

    def advance(self, physics, state, wrench):
        place = jnp.clip(state.pose[:, 0] + wrench[:, 0], 0.0, NUM_PLACES - 1.0)
        return State(state.pose.at[:, 0].set(place), state.twist)

    def reward(self, state, wrench, next_state, goal):
        return -jnp.abs(next_state.pose[0, 0] - goal[0, 0])

    def is_solved(self, state, goal):
        return jnp.abs(state.pose[0, 0] - goal[0, 0]) < 0.5

    def leaf_value(self, state, goal):
        return jnp.zeros(())

    def coordinates(self, state):
        return state.pose[0, :1]

    def observe(self, state):
        return state.pose[0, :1]

    def moved_freely(self, state, next_state):
        return jnp.ones(1, bool)
