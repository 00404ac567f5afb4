"""What the rest of an earlier plan is worth from here."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from boomdp_jax.core.arrays import IntScalar, Key
from boomdp_jax.planning.belief import Belief
from boomdp_jax.planning.problem import Problem


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
        previous: actions of the plan of the decision before, leading axis `level`.

    Returns:
        The value of the plan's next action, where that is more.
    """
    value, first = value_of_sequence(key, problem, belief, state, previous)
    is_first = (jnp.arange(problem.num_actions) == first)[None]
    return jnp.where(is_first, jnp.maximum(values, value[:, None]), values)


def value_of_sequence(
    key: Key, problem: Problem, belief: Belief, state: PyTree, sequence: PyTree
) -> tuple[Float[Array, " hypothesis"], IntScalar]:
    """Return of a plan whose first action is done, its last one held once more.

    Args:
        key: random key.
        problem: model, reward, actions.
        belief: hypotheses under which it is tried.
        state: where it goes on.
        sequence: actions of the plan, leading axis `level`.

    Returns:
        The return under each hypothesis, and which of the problem's actions comes
        first. As many calls of the model as a sequence has steps, for each hypothesis.
    """
    rest = jax.tree.map(lambda leaf: jnp.concatenate([leaf[1:], leaf[-1:]]), sequence)
    levels = jnp.arange(jax.tree.leaves(rest)[0].shape[0])

    def follow(hypothesis):
        def one(carry, step):
            state, value, discount = carry
            level, action = step
            outcome = problem.hold(
                jax.random.fold_in(key, level), hypothesis, state, action
            )
            # Once it is over nothing is paid, whatever a model makes of its last state.
            paid = jnp.where(discount > 0, discount * outcome.reward, 0.0)
            state = outcome.state
            return (state, value + paid, discount * outcome.continuation), None

        dtype = problem.discount.dtype
        start = (state, jnp.zeros((), dtype), jnp.ones((), dtype))
        (last, value, discount), _ = jax.lax.scan(one, start, (levels, rest))
        leaf = problem.leaf(hypothesis, last)
        value = value + jnp.where(discount > 0, discount * leaf, 0.0)
        return jnp.where(jnp.isfinite(value), value, -jnp.inf)

    first = jax.tree.map(lambda leaf: leaf[0], rest)
    return jax.vmap(follow)(belief.hypotheses), _index_of(problem, first)


def _index_of(problem: Problem, action: PyTree) -> IntScalar:
    """Which listed action it is; −1 for none."""
    same = jnp.ones(problem.num_actions, bool)
    for listed, one in zip(
        jax.tree.leaves(problem.actions), jax.tree.leaves(action), strict=True
    ):
        axes = tuple(range(1, listed.ndim))
        same = same & jnp.all(listed == one[None], axis=axes)
    return jnp.where(jnp.any(same), jnp.argmax(same), -1)
