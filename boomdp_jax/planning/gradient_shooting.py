r"""Planning uphill: gradient ascent on the return, through the model itself.

Sequences are points $z$ in coordinates of the box of actions (−1 to 1); after every
step of the optimiser, what left the box is moved to its edge. What is not finite of a
gradient counts as zero, so that one bad number, as at a contact, does not lose the
whole sequence.

Costs `num_starts` · (`num_steps` + 1) · `depth` steps of the model under each
hypothesis, and about twice that again for the gradients. Finds what no sampling finds
where the return is smooth and actions are many numbers; blind where the gradient is, as
before a push that has yet to touch.

Bharadhwaj et al. (2020), Model-predictive control via cross-entropy and gradient-based
optimization, section 3, without its cross-entropy half.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PyTree

from boomdp_jax.core.arrays import FloatScalar, Key
from boomdp_jax.planning.action_box import Box, action_box
from boomdp_jax.planning.belief import Belief
from boomdp_jax.planning.plan import Plan
from boomdp_jax.planning.problem import (
    LeafFn,
    Problem,
    RewardFn,
    TransitionFn,
    check_number,
    check_positive,
    check_state,
    make_problem,
)
from boomdp_jax.planning.rollouts import (
    Rollouts,
    draw_rollouts,
    read_inputs,
)
from boomdp_jax.planning.sequence_plan import plan_of_vectors, shifted


def gradient_shooting(
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
    num_starts: int = 8,
    num_steps: int = 40,
    learning_rate: float | Float[Array, ""] = 0.1,
    optimiser: optax.GradientTransformation | None = None,
    previous: Plan | None = None,
) -> Plan:
    """Choose the first action of the best sequence that gradient ascent came by.

    Compiled once for the same functions, optimiser and counts; functions or optimisers
    made anew for each call are compiled anew.

    Args:
        key: random key.
        belief: a `Belief`, a pair `(hypotheses, log_weight)`, or a posterior.
        state: where to plan from.
        transition_fn: the model, as `planning.problem` says; differentiable.
        reward_fn: what a step pays; differentiable.
        actions: array of floats `[action, dim]`, which span a box.
        depth: levels of the plan.
        discount: of one step of the model, in (0, 1].
        action_repeat: steps of the model for which an action is held.
        leaf_fn: value at the horizon; none: 0.
        num_hypotheses: how many to plan under at most.
        num_starts: sequences to start from: the middle of the box or the previous plan,
            and others drawn uniformly.
        num_steps: of the optimiser, from each.
        learning_rate: of Adam, in half widths of the box a step.
        optimiser: another one, which then has its own rate.
        previous: the plan of the decision before, to start from it.

    Returns:
        The plan, without values of the listed actions.

    Raises:
        TypeError: not a belief, or not a function.
        ValueError: a number outside its range, actions, weights or a previous plan that
            do not fit.
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
    num_starts = check_positive("num_starts", num_starts)
    num_steps = check_positive("num_steps", num_steps)
    check_number("learning_rate", learning_rate, "above 0", lambda x: x > 0)
    return _search(
        key,
        problem,
        belief,
        state,
        shifted(previous, problem, depth),
        jnp.asarray(learning_rate, float),
        optimiser,
        depth=depth,
        num_hypotheses=num_hypotheses,
        num_starts=num_starts,
        num_steps=num_steps,
    )


@eqx.filter_jit
def _search(
    key: Key,
    problem: Problem,
    belief: Belief,
    state: PyTree,
    start: PyTree | None,
    learning_rate: FloatScalar,
    optimiser: optax.GradientTransformation | None,
    *,
    depth: int,
    num_hypotheses: int,
    num_starts: int,
    num_steps: int,
) -> Plan:
    rollout_key, start_key = jax.random.split(key)
    rollouts = _without_weightless(
        draw_rollouts(rollout_key, problem, belief, state, depth, num_hypotheses)
    )
    box = action_box(problem.actions)
    if optimiser is None:
        optimiser = optax.adam(learning_rate.astype(box.centre.dtype))

    def value_of(z):
        return rollouts.mean(rollouts.returns(box.actions(z)))

    def climb(z):
        def step(carry, _):
            z, memory = carry
            value, slope = jax.value_and_grad(value_of)(z)
            slope = jnp.where(jnp.isfinite(slope), slope, 0.0)
            update, memory = optimiser.update(-slope, memory, z)
            moved = jnp.clip(z + update, -1.0, 1.0)
            return (moved, memory), (z, value)

        (last, _), (passed, values) = jax.lax.scan(
            step, (z, optimiser.init(z)), length=num_steps
        )
        values = jnp.append(values, value_of(last))
        best = jnp.argmax(values)
        return jnp.concatenate([passed, last[None]])[best], values[best]

    starts = _starts(start_key, box, start, depth, num_starts)
    found, values = jax.vmap(climb)(starts)
    best = jnp.argmax(values)
    num_sequences = num_starts * (num_steps + 1)
    return plan_of_vectors(
        rollouts, box.actions(found[best]), values[best], num_sequences
    )


def _without_weightless(rollouts: Rollouts) -> Rollouts:
    """Let the likeliest hypothesis stand in for those of no weight.

    They count for nothing in the return, but a NaN among them would in its gradient.
    """
    weight = rollouts.weight
    own = jnp.arange(weight.shape[0])
    index = jnp.where(weight > 0, own, jnp.argmax(weight).astype(own.dtype))
    hypotheses = jax.tree.map(lambda leaf: leaf[index], rollouts.hypotheses)
    return Rollouts(rollouts.problem, rollouts.state, hypotheses, weight, rollouts.keys)


def _starts(
    key: Key, box: Box, start: PyTree | None, depth: int, num: int
) -> Float[Array, "start level dim"]:
    shape, dtype = (num, depth, *box.centre.shape), box.centre.dtype
    drawn = jax.random.uniform(key, shape, dtype, minval=-1.0, maxval=1.0)
    first = jnp.zeros(shape[1:], dtype) if start is None else box.coordinates(start)
    return drawn.at[0].set(first)
