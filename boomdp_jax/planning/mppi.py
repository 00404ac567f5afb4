r"""Path integral control: the mean of random sequences, weighted by what they return.

Around a mean sequence, Gaussian noise is drawn in coordinates of the box of actions
(−1 to 1, what falls outside is moved to the edge; the first draw is the mean itself).
With returns $R_i$ and temperature $\lambda$ the new mean is
$\sum_i w_i z_i$, $w_i \propto e^{R_i / \lambda}$. Unlike there, nothing is charged for
the distance from the mean: the reward is all that counts.

Costs (`num_samples` · `num_iterations` + 1) · `depth` steps of the model under each
hypothesis, the last sequence to know the value of the new mean. Smoother actions than
the cross-entropy method's, from more samples; the mean of two good ways round an
obstacle may lead into it.

Williams et al. (2017), Information theoretic MPC for model-based reinforcement
learning, algorithm 2.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from boomdp_jax.core.arrays import FloatScalar, Key
from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.planning.action_box import action_box
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
from boomdp_jax.planning.rollouts import draw_rollouts, read_inputs
from boomdp_jax.planning.sequence_plan import plan_of_vectors, shifted


def mppi(
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
    num_iterations: int = 1,
    temperature: float | Float[Array, ""] = 0.1,
    relative: bool = True,
    noise_scale: float | Float[Array, ""] = 0.5,
    previous: Plan | None = None,
) -> Plan:
    """Choose the first action of a return-weighted mean of random sequences.

    Compiled once for the same functions and counts; functions made anew for each call
    are compiled anew.

    Args:
        key: random key.
        belief: a `Belief`, a pair `(hypotheses, log_weight)`, or a posterior.
        state: where to plan from.
        transition_fn: the model, as `planning.problem` says.
        reward_fn: what a step pays.
        actions: array of floats `[action, dim]`, which span a box.
        depth: levels of the plan.
        discount: of one step of the model, in (0, 1].
        action_repeat: steps of the model for which an action is held.
        leaf_fn: value at the horizon; none: 0.
        num_hypotheses: how many to plan under at most.
        num_samples: sequences of one iteration.
        num_iterations: how often to draw and average.
        temperature: how unequal returns may be and both still count: in standard
            deviations of the iteration's returns, so that scaling the reward changes
            nothing; unless `relative`, in units of the return.
        relative: which of the two.
        noise_scale: standard deviation of the noise, in half widths of the box.
        previous: the plan of the decision before, to start from it; none: from the
            middle of the box.

    Returns:
        The plan, without values of the listed actions; its value is the mean return of
        its sequence.

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
    num_samples = check_positive("num_samples", num_samples)
    num_iterations = check_positive("num_iterations", num_iterations)
    check_number("temperature", temperature, "above 0", lambda x: x > 0)
    check_number("noise_scale", noise_scale, "above 0", lambda x: x > 0)
    return _search(
        key,
        problem,
        belief,
        state,
        shifted(previous, problem, depth),
        jnp.asarray(temperature, float),
        jnp.asarray(noise_scale, float),
        depth=depth,
        num_hypotheses=num_hypotheses,
        num_samples=num_samples,
        num_iterations=num_iterations,
        relative=relative,
    )


@eqx.filter_jit
def _search(
    key: Key,
    problem: Problem,
    belief: Belief,
    state: PyTree,
    start: PyTree | None,
    temperature: FloatScalar,
    noise_scale: FloatScalar,
    *,
    depth: int,
    num_hypotheses: int,
    num_samples: int,
    num_iterations: int,
    relative: bool,
) -> Plan:
    rollout_key, sample_key = jax.random.split(key)
    rollouts = draw_rollouts(rollout_key, problem, belief, state, depth, num_hypotheses)
    box = action_box(problem.actions)
    shape, dtype = (depth, *box.centre.shape), box.centre.dtype
    mean = jnp.zeros(shape, dtype) if start is None else box.coordinates(start)

    def iterate(mean, key):
        noise = jax.random.normal(key, (num_samples, *shape), dtype).at[0].set(0.0)
        z = jnp.clip(mean[None] + noise_scale.astype(dtype) * noise, -1.0, 1.0)
        returns = jax.vmap(lambda one: rollouts.returns(box.actions(one)))(z)
        weight = _weight(rollouts.mean(returns), temperature, relative).astype(dtype)
        return jnp.where(jnp.sum(weight) > 0, _average(weight, z), mean), None

    mean, _ = jax.lax.scan(iterate, mean, jax.random.split(sample_key, num_iterations))
    sequence = box.actions(mean)
    value = rollouts.mean(rollouts.returns(sequence))
    num_sequences = num_samples * num_iterations + 1
    return plan_of_vectors(rollouts, sequence, value, num_sequences)


def _weight(
    value: Float[Array, " sample"], temperature: FloatScalar, relative: bool
) -> Float[Array, " sample"]:
    """Of a sum of one, or all zero where no value is finite."""
    is_finite = jnp.isfinite(value)
    value = jnp.where(is_finite, value, 0.0)
    if relative:
        temperature = temperature * jnp.std(value, where=is_finite)
    tiny = jnp.finfo(value.dtype).tiny
    best = jnp.max(value, where=is_finite, initial=-jnp.inf)
    gap = jnp.where(is_finite, value - best, -jnp.inf)
    weight = jnp.exp(gap / jnp.maximum(temperature, tiny))
    return weight / jnp.maximum(jnp.sum(weight), 1.0)


@full_precision
def _average(
    weight: Float[Array, " sample"], sequences: Float[Array, "sample *shape"]
) -> Float[Array, "*shape"]:
    """Weighted mean of sequences."""
    return jnp.tensordot(weight, sequences, axes=1)
