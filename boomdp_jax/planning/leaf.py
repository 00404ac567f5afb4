"""What is to be had beyond the horizon, found by following a fixed policy.

A cheap value for the end of a plan where none is known in closed form: a policy that is
only fairly good makes a short plan look further. Costs `num_steps` steps of the model
for every leaf, which planners do not count.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from boomdp_jax.core.arrays import FloatScalar, Key
from boomdp_jax.planning.problem import (
    Problem,
    RewardFn,
    TransitionFn,
    check_positive,
    make_problem,
)

PolicyFn = Callable[[Any, Any], Any]


class RolloutLeaf(eqx.Module):
    """A leaf function: the return of a policy over some steps."""

    problem: Problem
    policy_fn: PolicyFn
    key: Key
    """The same for every state and hypothesis, so that they compare by common noise."""
    num_steps: int = eqx.field(static=True)

    def __call__(self, hypothesis: PyTree, state: PyTree) -> FloatScalar:
        """Roll out from a state.

        Args:
            hypothesis: what the world is taken to be.
            state: where it starts.

        Returns:
            Discounted return, without a value for where it ends.
        """

        def step(carry, key):
            state, total, factor = carry
            action = self.policy_fn(hypothesis, state)
            outcome = self.problem.hold(key, hypothesis, state, action)
            total = total + jnp.where(factor > 0, factor * outcome.reward, 0.0)
            return (outcome.state, total, factor * outcome.continuation), None

        one = jnp.ones_like(self.problem.discount)
        start = (jax.tree.map(jnp.asarray, state), jnp.zeros_like(one), one)
        keys = jax.random.split(self.key, self.num_steps)
        (_, total, _), _ = jax.lax.scan(step, start, keys)
        return total


def rollout_leaf(
    transition_fn: TransitionFn,
    reward_fn: RewardFn,
    policy_fn: PolicyFn,
    num_steps: int,
    discount: float | Float[Array, ""] = 1.0,
    *,
    key: Key | None = None,
) -> RolloutLeaf:
    """Make a leaf function of a policy.

    Args:
        transition_fn: the model, as `planning.problem` says.
        reward_fn: what a step pays.
        policy_fn: `policy_fn(hypothesis, state) -> action`.
        num_steps: of the model, each with an action of its own.
        discount: of one step, in (0, 1].
        key: the noise of the model; none: that of seed 0.

    Returns:
        `leaf_fn` of any planner; two of the same functions share a compiled program.

    Raises:
        TypeError: not a function.
        ValueError: no step, or a discount outside (0, 1].
    """
    num_steps = check_positive("num_steps", num_steps)
    # The policy's actions need not be listed: one stands for them all.
    problem = make_problem(transition_fn, reward_fn, 1, discount=discount)
    key = jax.random.key(0) if key is None else key
    return RolloutLeaf(problem, policy_fn, key, num_steps)
