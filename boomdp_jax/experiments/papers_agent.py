"""The papers' own recipe on their cart, as a control for every claim about ours.

Metropolis from the prior after steps 1, 2, 4, 8..., 30 chains of 20,000 iterations as
published; the draw of the highest density; A* over a grid. The cells are those that our
own planner merges by, and the heuristic, which was not published, is the length of the
way round the walls: with the straight distance A* searches the whole room. Agents of
ours that are told that length as well (`way_leaf`) are what it compares with like for
like.
"""

import numpy as np

from boomdp_jax.agents.agent import Agent
from boomdp_jax.agents.path_agent import make_path_agent
from boomdp_jax.envs.cart import Cart
from boomdp_jax.envs.environment import EnvParams
from boomdp_jax.envs.ways import way_to
from boomdp_jax.models.metropolis_model import MetropolisModel
from boomdp_jax.planning.problem import LeafFn

_LEAF_STEPS = 10.0
"""Rewards that a metre of the way stands for."""


def way_leaf(task: Cart, params: EnvParams) -> LeafFn:
    """A leaf value that knows the walls: the length of the way round them.

    Args:
        task: the cart.
        params: its world, of which the goal is told.

    Returns:
        From hypothesis and state to a value in the task's rewards.
    """
    outline = np.asarray(task.outline.vertices)
    way = way_to(
        task.walls,
        np.asarray(params.goal[0, :2]),
        np.zeros(2),
        np.max(np.asarray(task.walls.middle), axis=0),
        margin=float(np.min(np.ptp(outline, axis=0))) / 2,
    )

    def leaf(hypothesis, state):
        return -_LEAF_STEPS * way(state.pose[0, :2])

    return leaf


def papers_agent(task: Cart, params: EnvParams) -> Agent:
    """Put it together.

    Args:
        task: the cart.
        params: its world, of which the goal is told.
    """
    model = MetropolisModel(task.spec, task.advance, task.moved_freely)
    leaf = way_leaf(task, params)
    return make_path_agent("papers", task, model, params.goal, leaf_fn=leaf)
