"""What sequences of actions really pay, step by step from the state itself.

A merged tree takes a state for another one in its cell, level after level, and its
values are off by that; without noise, trying a plan tells what it is worth.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from boomdp_jax.core.arrays import FloatScalar, IntScalar, Key
from boomdp_jax.planning.belief import Belief
from boomdp_jax.planning.problem import Problem
from boomdp_jax.planning.tree import Tree, best_sequence


def value_of_sequence(
    key: Key, problem: Problem, hypothesis: PyTree, state: PyTree, sequence: PyTree
) -> FloatScalar:
    """Return of a sequence of actions under one hypothesis, leaf value included.

    Args:
        key: random key.
        problem: model and reward.
        hypothesis: what the world is taken to be.
        state: where it starts.
        sequence: actions, leading axis `level`.

    Returns:
        The return; −∞ where it is not finite. As many calls of the model as a sequence
        has steps.
    """

    def one(carry, step):
        state, value, discount = carry
        level, action = step
        level_key = jax.random.fold_in(key, level)
        outcome = problem.hold(level_key, hypothesis, state, action)
        # Once it is over nothing is paid, whatever a model makes of its last state.
        paid = jnp.where(discount > 0, discount * outcome.reward, 0.0)
        carry = (outcome.state, value + paid, discount * outcome.continuation)
        return carry, None

    dtype = problem.discount.dtype
    levels = jnp.arange(jax.tree.leaves(sequence)[0].shape[0])
    start = (state, jnp.zeros((), dtype), jnp.ones((), dtype))
    (last, value, discount), _ = jax.lax.scan(one, start, (levels, sequence))
    leaf = problem.leaf(hypothesis, last)
    value = value + jnp.where(discount > 0, discount * leaf, 0.0)
    return jnp.where(jnp.isfinite(value), value, -jnp.inf)


def verified_values(
    key: Key, problem: Problem, belief: Belief, state: PyTree, tree: Tree
) -> Float[Array, "hypothesis action"]:
    """Values of the root's actions, each by following the tree's plan that begins so.

    Args:
        key: random key.
        problem: model, reward, actions.
        belief: the hypotheses that the trees are for.
        state: the root.
        tree: leading axis `hypothesis`.

    Returns:
        Returns of the plans: what an action is worth at least, where there is no noise.
    """

    def of_hypothesis(hypothesis, tree):
        def of_action(action):
            sequence = problem.action(best_sequence(tree, action))
            return value_of_sequence(key, problem, hypothesis, state, sequence)

        return jax.vmap(of_action)(jnp.arange(problem.num_actions))

    return jax.vmap(of_hypothesis)(belief.hypotheses, tree)


def with_previous(
    key: Key,
    problem: Problem,
    belief: Belief,
    state: PyTree,
    values: Float[Array, "hypothesis action"],
    previous: PyTree,
) -> Float[Array, "hypothesis action"]:
    """What actions are worth, given a plan that could be gone on with.

    Args:
        key: random key.
        problem: model, reward, actions.
        belief: hypotheses under which it is tried.
        state: where it goes on.
        values: of each action, without it.
        previous: actions of the plan of the decision before, leading axis `level`; the
            first is done, the last one is held once more.

    Returns:
        The value of the plan's next action, where that is more.
    """
    rest = jax.tree.map(lambda leaf: jnp.concatenate([leaf[1:], leaf[-1:]]), previous)
    value = jax.vmap(lambda h: value_of_sequence(key, problem, h, state, rest))(
        belief.hypotheses
    )
    first = _index_of(problem, jax.tree.map(lambda leaf: leaf[0], rest))
    is_first = (jnp.arange(problem.num_actions) == first)[None]
    return jnp.where(is_first, jnp.maximum(values, value[:, None]), values)


def _index_of(problem: Problem, action: PyTree) -> IntScalar:
    """Which listed action it is; −1 for none."""
    same = jnp.ones(problem.num_actions, bool)
    for listed, one in zip(
        jax.tree.leaves(problem.actions), jax.tree.leaves(action), strict=True
    ):
        axes = tuple(range(1, listed.ndim))
        same = same & jnp.all(listed == one[None], axis=axes)
    return jnp.where(jnp.any(same), jnp.argmax(same), -1)
