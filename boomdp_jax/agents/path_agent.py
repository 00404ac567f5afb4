"""An agent that follows the best path to a goal under its one best hypothesis.

The papers' successor: A* on a discretised state space, transitions continuous, under a
point estimate, planned anew at each decision.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.agents.agent import Agent
from boomdp_jax.envs.environment import AbstractEnvironment
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.planning.a_star import a_star
from boomdp_jax.planning.problem import LeafFn

# Cells that are reached at the same time are expanded together: the model in a batch.
_NUM_AT_ONCE = 8


def make_path_agent(
    name: str,
    task: AbstractEnvironment,
    model: AbstractModel,
    goal: Float[Array, "body 3"],
    *,
    leaf_fn: LeafFn | None = None,
    max_expansions: int = 4096,
) -> Agent:
    """An agent that plans by A*, on the grid of a task's hints.

    Args:
        name: for reports.
        task: what is to be done; it has an end.
        model: of which the most probable hypothesis counts.
        goal: pose that each body is to come to.
        leaf_fn: `(hypothesis, state) -> value` that leads the search; default: the
            task's leaf value.
        max_expansions: states whose actions are all tried, at most, for one decision.

    Returns:
        The agent.
    """
    hints = task.hints

    def transition(key, hypothesis, state, wrench):
        next_state = model.transition(key, hypothesis, state, wrench)
        return next_state, task.is_solved(next_state, goal)

    def reward(hypothesis, state, wrench, next_state):
        return task.reward(state, wrench, next_state, goal)

    def leaf(hypothesis, state):
        return task.leaf_value(state, goal)

    @jax.jit
    def compiled(key, belief, state):
        return a_star(
            key,
            belief,
            state,
            transition_fn=transition,
            reward_fn=reward,
            actions=task.actions.wrench,
            cell_size=jnp.asarray(hints.cell_size),
            coordinates_fn=task.coordinates,
            action_repeat=hints.action_repeat,
            leaf_fn=leaf if leaf_fn is None else leaf_fn,
            max_expansions=max_expansions,
            num_expanded_at_once=_NUM_AT_ONCE,
        )

    def plan(key, belief, state, previous):
        del previous
        return compiled(key, belief, state)

    return Agent(
        name=name,
        model=model,
        plan=plan,
        num_hypotheses=1,
        num_held=hints.action_repeat,
    )
