"""Planning by luck: the best of many sequences of actions drawn blindly.

Costs `num_samples` · `depth` steps of the model under each hypothesis. The yardstick of
every other planner: of $k$ actions over $H$ levels there are $k^H$ sequences, and only
where that is no more than some thousands, or most sequences do, is it a good choice.

Nagabandi et al. (2018), Neural network dynamics for model-based deep reinforcement
learning with model-free fine-tuning, section IV-C.
"""

from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array, Float, PyTree

from boomdp_jax.core.arrays import Key
from boomdp_jax.planning.belief import Belief
from boomdp_jax.planning.plan import Plan
from boomdp_jax.planning.problem import (
    LeafFn,
    Problem,
    RewardFn,
    TransitionFn,
    check_positive,
    check_state,
    make_problem,
)
from boomdp_jax.planning.rollouts import draw_rollouts, read_inputs
from boomdp_jax.planning.sequence_plan import plan_of_indices


def random_shooting(
    key: Key,
    belief: Any,
    state: PyTree,
    *,
    transition_fn: TransitionFn,
    reward_fn: RewardFn,
    actions: PyTree | int,
    depth: int,
    discount: float | Float[Array, ""] = 1.0,
    action_repeat: int = 1,
    leaf_fn: LeafFn | None = None,
    num_hypotheses: int = 16,
    num_samples: int = 1024,
) -> Plan:
    """Choose the first action of the best of some random sequences.

    Compiled once for the same functions and counts; functions made anew for each call
    are compiled anew.

    Args:
        key: random key.
        belief: a `Belief`, a pair `(hypotheses, log_weight)`, or a posterior.
        state: where to plan from.
        transition_fn: the model, as `planning.problem` says.
        reward_fn: what a step pays.
        actions: any pytree with a leading axis `action`, or how many there are.
        depth: levels of the plan.
        discount: of one step of the model, in (0, 1].
        action_repeat: steps of the model for which an action is held.
        leaf_fn: value at the horizon; none: 0.
        num_hypotheses: how many to plan under at most.
        num_samples: sequences, drawn uniformly.

    Returns:
        The plan; the value of an action is the best return that began with it, −∞ where
        it was not tried.

    Raises:
        TypeError: not a belief, or not a function.
        ValueError: a count that is not positive, a discount outside (0, 1], actions or
            weights that do not fit.
    """
    check_state(state)
    problem = make_problem(
        transition_fn,
        reward_fn,
        actions,
        leaf_fn=leaf_fn,
        discount=discount,
        action_repeat=action_repeat,
    )
    belief, state, depth, num_hypotheses = read_inputs(
        belief, state, depth=depth, num_hypotheses=num_hypotheses
    )
    num_samples = check_positive("num_samples", num_samples)
    return _search(key, problem, belief, state, depth, num_hypotheses, num_samples)


@eqx.filter_jit
def _search(
    key: Key,
    problem: Problem,
    belief: Belief,
    state: PyTree,
    depth: int,
    num_hypotheses: int,
    num_samples: int,
) -> Plan:
    rollout_key, sample_key = jax.random.split(key)
    rollouts = draw_rollouts(rollout_key, problem, belief, state, depth, num_hypotheses)
    shape = (num_samples, depth)
    indices = jax.random.randint(sample_key, shape, 0, problem.num_actions)
    returns = jax.vmap(lambda row: rollouts.returns(problem.action(row)))(indices)
    return plan_of_indices(rollouts, indices, returns)
