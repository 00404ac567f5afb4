r"""The cross-entropy method: draw sequences, refit what draws them to the best.

Continuous actions are drawn from independent Gaussians, one for each level and number
of an action, in coordinates of the box around the listed actions (−1 to 1, what falls
outside is moved to the edge); listed ones from independent probabilities at each level.
With smoothing $\alpha$ every parameter becomes
$\alpha \cdot \text{old} + (1 - \alpha) \cdot \text{that of the elite}$. The first draw
of an iteration is the middle itself: the mean, or the likeliest action of each level.

Costs `num_samples` · `num_iterations` · `depth` steps of the model under each
hypothesis. A good first choice for smooth returns of few peaks; it commits itself to
one of several, and round a wall often to the wrong one.

De Boer et al. (2005), A tutorial on the cross-entropy method, sections 3 and 5.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from boomdp_jax.core.arrays import FloatScalar, Key
from boomdp_jax.planning.action_box import Box, action_box, nearest
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
from boomdp_jax.planning.sequence_plan import plan_of_indices, plan_of_vectors, shifted

# What the shifted last plan weighs among the probabilities of listed actions at first:
# enough that whole sequences near it are drawn, not so much that no other is.
_PREVIOUS_PROBABILITY = 0.5


def cross_entropy_method(
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
    num_samples: int = 256,
    num_iterations: int = 4,
    elite_fraction: float = 0.1,
    smoothing: float | Float[Array, ""] = 0.1,
    min_sd: float | Float[Array, ""] = 0.05,
    continuous: bool = True,
    previous: Plan | None = None,
) -> Plan:
    """Choose the first action of the best sequence that the method ever drew.

    Compiled once for the same functions and counts; functions made anew for each call
    are compiled anew.

    Args:
        key: random key.
        belief: a `Belief`, a pair `(hypotheses, log_weight)`, or a posterior.
        state: where to plan from.
        transition_fn: the model, as `planning.problem` says.
        reward_fn: what a step pays.
        actions: array of floats `[action, dim]`, which span a box; unless `continuous`,
            any pytree with a leading axis `action`, or how many there are.
        depth: levels of the plan.
        discount: of one step of the model, in (0, 1].
        action_repeat: steps of the model for which an action is held.
        leaf_fn: value at the horizon; none: 0.
        num_hypotheses: how many to plan under at most.
        num_samples: sequences of one iteration.
        num_iterations: how often to draw and refit.
        elite_fraction: part of the draws to refit to, in (0, 1]; at least one is.
        smoothing: part of the old parameters that stays, in [0, 1).
        min_sd: below which no standard deviation falls, in half widths of the box.
        continuous: whether to choose from the whole box, or among listed actions.
        previous: the plan of the decision before, to start from it.

    Returns:
        The plan; continuous: without values of the listed actions, else the value of an
        action is the best return that began with it, −∞ where it was not tried.

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
    check_number("elite_fraction", elite_fraction, "in (0, 1]", lambda x: 0 < x <= 1)
    check_number("smoothing", smoothing, "in [0, 1)", lambda x: 0 <= x < 1)
    check_number("min_sd", min_sd, "not below 0", lambda x: x >= 0)
    return _search(
        key,
        problem,
        belief,
        state,
        shifted(previous, problem, depth),
        jnp.asarray(smoothing, float),
        jnp.asarray(min_sd, float),
        depth=depth,
        num_hypotheses=num_hypotheses,
        num_samples=num_samples,
        num_iterations=num_iterations,
        num_elites=max(1, round(float(elite_fraction) * num_samples)),
        continuous=continuous,
    )


@eqx.filter_jit
def _search(
    key: Key,
    problem: Problem,
    belief: Belief,
    state: PyTree,
    start: PyTree | None,
    smoothing: FloatScalar,
    min_sd: FloatScalar,
    *,
    depth: int,
    num_hypotheses: int,
    num_samples: int,
    num_iterations: int,
    num_elites: int,
    continuous: bool,
) -> Plan:
    rollout_key, sample_key = jax.random.split(key)
    rollouts = draw_rollouts(rollout_key, problem, belief, state, depth, num_hypotheses)
    if continuous:
        law = _wide_gaussian(action_box(problem.actions), start, depth, min_sd)
    else:
        law = _even_choice(problem, start, depth)

    def iterate(law, key):
        drawn = law.draw(key, num_samples)
        returns = jax.vmap(lambda one: rollouts.returns(law.sequence(problem, one)))(
            drawn
        )
        _, elite = jax.lax.top_k(rollouts.mean(returns), num_elites)
        return law.refitted(drawn[elite], smoothing), (drawn, returns)

    keys = jax.random.split(sample_key, num_iterations)
    _, drawn_returns = jax.lax.scan(iterate, law, keys)
    drawn, returns = jax.tree.map(
        lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), drawn_returns
    )
    if not continuous:
        return plan_of_indices(rollouts, drawn, returns)
    mean = rollouts.mean(returns)
    best = jnp.argmax(mean)
    sequence = law.sequence(problem, drawn[best])
    return plan_of_vectors(rollouts, sequence, mean[best], drawn.shape[0])


class _Gaussian(eqx.Module):
    """Of sequences of vectors, in coordinates of the box."""

    box: Box
    mean: Float[Array, "level dim"]
    sd: Float[Array, "level dim"]
    min_sd: FloatScalar

    def draw(self, key: Key, num: int) -> Float[Array, "sample level dim"]:
        noise = jax.random.normal(key, (num, *self.mean.shape), self.mean.dtype)
        z = self.mean[None] + self.sd[None] * noise.at[0].set(0.0)
        return jnp.clip(z, -1.0, 1.0)

    def sequence(
        self, problem: Problem, z: Float[Array, "level dim"]
    ) -> Float[Array, "level dim"]:
        del problem
        return self.box.actions(z)

    def refitted(
        self, elite: Float[Array, "elite level dim"], smoothing: FloatScalar
    ) -> "_Gaussian":
        old = smoothing.astype(elite.dtype)
        mean = old * self.mean + (1 - old) * jnp.mean(elite, axis=0)
        sd = old * self.sd + (1 - old) * jnp.std(elite, axis=0)
        return _Gaussian(self.box, mean, jnp.maximum(sd, self.min_sd), self.min_sd)


def _wide_gaussian(
    box: Box, start: PyTree | None, depth: int, min_sd: FloatScalar
) -> _Gaussian:
    shape, dtype = (depth, *box.centre.shape), box.centre.dtype
    mean = jnp.zeros(shape, dtype) if start is None else box.coordinates(start)
    return _Gaussian(box, mean, jnp.ones(shape, dtype), min_sd.astype(dtype))


class _Choice(eqx.Module):
    """Of sequences of listed actions, by index."""

    probability: Float[Array, "level action"]

    def draw(self, key: Key, num: int) -> Int[Array, "sample level"]:
        shape = (num, self.probability.shape[0])
        drawn = jax.random.categorical(key, jnp.log(self.probability), shape=shape)
        return drawn.at[0].set(jnp.argmax(self.probability, axis=1))

    def sequence(self, problem: Problem, indices: Int[Array, " level"]) -> PyTree:
        return problem.action(indices)

    def refitted(
        self, elite: Int[Array, "elite level"], smoothing: FloatScalar
    ) -> "_Choice":
        num_actions = self.probability.shape[1]
        frequency = jnp.mean(jax.nn.one_hot(elite, num_actions), axis=0)
        return _Choice(smoothing * self.probability + (1 - smoothing) * frequency)


def _even_choice(problem: Problem, start: PyTree | None, depth: int) -> _Choice:
    num_actions = problem.num_actions
    even = jnp.full((depth, num_actions), 1.0 / num_actions)
    if start is None:
        return _Choice(even)
    index = jax.vmap(lambda action: nearest(problem, action))(start)
    again = jax.nn.one_hot(index, num_actions)
    return _Choice((1 - _PREVIOUS_PROBABILITY) * even + _PREVIOUS_PROBABILITY * again)
