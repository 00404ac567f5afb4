"""Model, planner and exploration: what acts, and learns from what it sees."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from boomdp_jax.core.arrays import IntScalar, Key
from boomdp_jax.envs.environment import AbstractEnvironment
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.physics.state import State
from boomdp_jax.planning.belief import Belief
from boomdp_jax.planning.plan import Plan, plan_of
from boomdp_jax.planning.problem import LeafFn
from boomdp_jax.planning.sparse_sampling import sparse_sampling

PlanFn = Callable[[Key, Any, State, Plan | None], Plan]
"""`(key, belief, state, plan of the decision before)` to a plan."""

ExploreFn = Callable[[Key, Any, State, IntScalar], int | None]
"""`(key, learnt, state, planned action)` to an action to do instead, or none; on the
host."""


class Agent(eqx.Module):
    """A model, and how it is planned with.

    The belief that a plan rests on is drawn anew for each decision (posterior sampling
    at the root), so that an agent tries what some of its hypotheses promise.
    """

    name: str = eqx.field(static=True)
    model: AbstractModel
    plan: PlanFn | None = eqx.field(static=True)
    """None: actions are drawn at random."""
    num_hypotheses: int = eqx.field(static=True)
    """Drawn from the model for each decision."""
    num_held: int = eqx.field(static=True)
    """Steps for which a decision is carried out."""
    exploration: float = eqx.field(static=True, default=0.0)
    """Probability that a decision is any action instead of the planned one. Who learns
    one law and no distribution over laws needs it: what is never tried is never
    learnt."""
    explore: ExploreFn | None = eqx.field(static=True, default=None)
    """What may be done instead of the planned action, for what it tells."""

    def decide(
        self,
        key: Key,
        belief: Belief,
        state: State,
        previous: Plan | None,
        num_actions: int,
        learnt: PyTree = None,
    ) -> tuple[IntScalar, Plan | None]:
        """Choose an action.

        Args:
            key: random key.
            belief: a sample of the model's.
            state: as read.
            previous: the plan of the decision before, if it was carried out.
            num_actions: of the task.
            learnt: by the model, for those who explore by it.

        Returns:
            Index of the action, and the plan it is from; none, if it is from chance or
            for what it tells.
        """
        key, try_key, any_key = jax.random.split(key, 3)
        tries = self.exploration > 0 and bool(
            jax.random.bernoulli(try_key, self.exploration)
        )
        if self.plan is None or tries:
            return jax.random.randint(any_key, (), 0, num_actions), None
        plan = self.plan(key, belief, state, previous)
        if self.explore is not None:
            told = self.explore(any_key, learnt, state, plan.index)
            if told is not None:
                return jnp.asarray(told, plan.index.dtype), None
        return plan.index, plan


def make_agent(
    name: str,
    task: AbstractEnvironment,
    model: AbstractModel,
    goal: Float[Array, "body 3"],
    *,
    num_hypotheses: int = 4,
    capacity: int | None = None,
    exploration: float = 0.0,
    leaf_fn: LeafFn | None = None,
    explore: ExploreFn | None = None,
) -> Agent:
    """An agent that plans with sparse sampling, by a task's own hints.

    Args:
        name: for reports.
        task: what is to be done.
        model: how the agent thinks that the world moves.
        goal: pose that each body is to come to.
        num_hypotheses: drawn from the model for each decision.
        capacity: nodes of a level; default: the task's hint.
        exploration: probability that a decision is any action.
        leaf_fn: `(hypothesis, state) -> value` of what is left at the horizon; default:
            the task's leaf value.
        explore: what may be done instead of the planned action.

    Returns:
        The agent.

    Raises:
        ValueError: a number below one, or a probability outside [0, 1].
    """
    for field, number in (("num_hypotheses", num_hypotheses), ("capacity", capacity)):
        if number is not None and number < 1:
            raise ValueError(f"{field}: expected at least 1, got {number}")
    if not 0.0 <= exploration <= 1.0:
        raise ValueError(f"exploration: expected in [0, 1], got {exploration}")
    hints = task.hints
    cells, strata = jnp.asarray(hints.cell_size), jnp.asarray(hints.stratum_size)

    def transition(key, hypothesis, state, wrench):
        next_state = model.transition(key, hypothesis, state, wrench)
        return next_state, task.is_solved(next_state, goal)

    def reward(hypothesis, state, wrench, next_state):
        return task.reward(state, wrench, next_state, goal)

    def leaf(hypothesis, state):
        return task.leaf_value(state, goal)

    @jax.jit
    def compiled(key, belief, state, sequence):
        return sparse_sampling(
            key,
            belief,
            state,
            transition_fn=transition,
            reward_fn=reward,
            actions=task.actions.wrench,
            depth=hints.depth,
            action_repeat=hints.action_repeat,
            leaf_fn=leaf if leaf_fn is None else leaf_fn,
            num_hypotheses=num_hypotheses,
            cell_size=cells,
            stratum_size=strata,
            coordinates_fn=task.coordinates,
            capacity=capacity or hints.capacity,
            verify=True,
            previous=plan_of(sequence),
        )

    nothing = jnp.zeros((hints.depth, *task.actions.wrench.shape[1:]))

    def plan(key, belief, state, previous):
        # A plan to do nothing stands for none, so that all decisions are one program.
        return compiled(
            key, belief, state, nothing if previous is None else previous.sequence
        )

    return Agent(
        name=name,
        model=model,
        plan=plan,
        num_hypotheses=num_hypotheses,
        num_held=hints.action_repeat,
        exploration=float(exploration),
        explore=explore,
    )


def random_agent(model: AbstractModel, num_held: int = 1) -> Agent:
    """An agent that tries anything, and may learn a model meanwhile."""
    return Agent(
        name="random", model=model, plan=None, num_hypotheses=1, num_held=num_held
    )
