r"""Sparse sampling that leaves out what cannot change the decision.

Forward-search sparse sampling walks from the root to the horizon again and again, each
time along the action of the largest upper bound and the draw whose value is least
known, and stops when no other action can be better than the best one. It decides as the
whole tree of $(A C)^H$ leaves does, and estimates the same return, from a part of it.

With several hypotheses there is one tree each, and all walks begin with the action
whose upper bound is largest on average; the averages also tell when to stop.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from boomdp_jax.core.arrays import BoolScalar, Key
from boomdp_jax.planning.belief import Belief, as_belief, resample
from boomdp_jax.planning.lazy_tree import LazyTree, most_promising
from boomdp_jax.planning.plan import Plan, SearchInfo
from boomdp_jax.planning.problem import (
    LeafFn,
    RewardFn,
    TransitionFn,
    check_positive,
    check_state,
    make_problem,
)
from boomdp_jax.planning.return_bounds import BoundFn, make_bounds
from boomdp_jax.planning.tree_growth import Growth


class ForwardSearchReport(NamedTuple):
    """How far a forward search came; what `Plan.tree` holds after one."""

    lower: Float[Array, " action"]
    """Bound of the return of each action at the root, averaged over hypotheses; of the
    return by the whole sparse-sampling tree."""
    upper: Float[Array, " action"]
    is_solved: BoolScalar
    """The whole tree would have chosen no better; False where the budget was spent."""
    is_exact: BoolScalar
    """`value` is that of the whole tree, not the middle of an interval."""
    num_expansions: Int[Array, " hypothesis"]
    """Nodes whose children were drawn."""
    num_contradictions: Int[Array, " hypothesis"]
    """Expansions after which a node's bounds were wider than before, or crossed. More
    than none: `value_bounds` or `leaf_bounds` are wrong, and so may the decision be.
    Bounds by functions may also be right but tell less of a state's successors than of
    the state. None is no proof: what was left out was not looked at."""


def forward_search_sparse_sampling(
    key: Key,
    belief: Any,
    state: PyTree,
    *,
    transition_fn: TransitionFn,
    reward_fn: RewardFn,
    actions: PyTree | int,
    depth: int,
    num_samples: int = 1,
    value_bounds: tuple[Any, Any] | None = None,
    leaf_bounds: tuple[Any, Any] | None = None,
    lower_fn: BoundFn | None = None,
    upper_fn: BoundFn | None = None,
    max_expansions: int = 1000,
    exact_value: bool = True,
    discount: float | Float[Array, ""] = 1.0,
    action_repeat: int = 1,
    leaf_fn: LeafFn | None = None,
    num_hypotheses: int = 16,
    common_random_numbers: bool = True,
) -> Plan:
    """Plan by a sparse-sampling tree of which only what matters is grown.

    At most `max_expansions` times `actions` times `num_samples` outcomes are drawn for
    each hypothesis. To be preferred to the whole tree where bounds of the return are
    tight; with loose ones nearly every node is visited, one after another, which the
    whole tree does in parallel. Over many states `jax.lax.map` is several times faster
    on a processor than `jax.vmap`, which copies whole trees in every round. Walsh,
    Goschin and Littman (2010), "Integrating sample-based planning and model-based
    reinforcement learning".

    Args:
        key: random key; the draws of a node depend on it and on where the node is in
            the tree, not on when it is reached, and are the same under all hypotheses.
        belief: what is known of the world, in any form that `Belief` has.
        state: where to plan from.
        transition_fn: `(key, hypothesis, state, action) -> (next_state, done)`.
        reward_fn: `(hypothesis, state, action, next_state) -> reward`.
        actions: pytree with a leading axis `action`, or how many there are.
        depth: decisions up to the horizon.
        num_samples: draws of each action at a node; 1 is enough for a model without
            noise.
        value_bounds: least and largest reward of one step of the model.
        leaf_bounds: least and largest leaf value, needed with `leaf_fn` and
            `value_bounds`.
        lower_fn: `(hypothesis, state, num_left) -> bound` of the best plan's return
            with so many decisions left, leaf value included; finite. In the place of
            the lower one of `value_bounds`.
        upper_fn: the same for the upper bound.
        max_expansions: nodes to be expanded under each hypothesis at most; bounds time
            and memory.
        exact_value: search on until the value of the chosen action is that of the whole
            tree; else stop at the decision, its value only bounded.
        discount: of one step of the model, in (0, 1].
        action_repeat: steps of the model for which an action is held.
        leaf_fn: `(hypothesis, state) -> value` at the horizon; none: 0.
        num_hypotheses: draws from a belief of more.
        common_random_numbers: whether all actions at a node meet the same noise.

    Returns:
        The plan. Where a return is not known exactly, its estimate is the middle
        between the bounds; it is −∞ where a reward is not finite or a leaf value NaN.
        `sequence` follows the first draw of each action and repeats the last one where
        the tree ends; `tree` is a `ForwardSearchReport`.

    Raises:
        TypeError: an argument that should be a function or a belief is none.
        ValueError: a count that is not positive, bounds missing or in the wrong order,
            no action, a discount outside (0, 1].
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
    depth = check_positive("depth", depth)
    num_samples = check_positive("num_samples", num_samples)
    max_expansions = check_positive("max_expansions", max_expansions)
    num_hypotheses = check_positive("num_hypotheses", num_hypotheses)
    bounds = make_bounds(
        problem,
        depth,
        value_bounds=value_bounds,
        leaf_bounds=leaf_bounds,
        lower_fn=lower_fn,
        upper_fn=upper_fn,
    )
    growth = Growth(problem, bounds, depth, num_samples, common_random_numbers)
    width = problem.num_actions * num_samples
    max_expansions = min(max_expansions, sum(width**level for level in range(depth)))
    return _search(
        key,
        as_belief(belief),
        jax.tree.map(jnp.asarray, state),
        growth,
        max_expansions,
        num_hypotheses,
        exact_value,
    )


@eqx.filter_jit
def _search(
    key: Key,
    belief: Belief,
    state: PyTree,
    growth: Growth,
    max_expansions: int,
    num_hypotheses: int,
    exact_value: bool,
) -> Plan:
    """Grow all trees until the decision is known, and read it off."""
    # No transition has the key of this level.
    belief = resample(jax.random.fold_in(key, growth.depth), belief, num_hypotheses)
    grow = jax.vmap(growth.grow, in_axes=(None, 0, 0, None))

    def goes_on(carry):
        num_rounds, trees = carry
        is_solved, is_exact = _verdict(*_averages(belief, *_root_bounds(trees)))
        is_done = is_exact if exact_value else is_solved
        return (num_rounds == 0) | ((num_rounds < max_expansions) & ~is_done)

    def advance(carry):
        num_rounds, trees = carry
        action = most_promising(*_averages(belief, *_root_bounds(trees)))
        return num_rounds + 1, grow(key, belief.hypotheses, trees, action)

    trees = jax.vmap(growth.plant, in_axes=(0, None, None))(
        belief.hypotheses, state, max_expansions
    )
    _, trees = jax.lax.while_loop(goes_on, advance, (jnp.zeros((), jnp.int32), trees))
    return _read(belief, growth, trees)


def _root_bounds(
    trees: LazyTree,
) -> tuple[Float[Array, "hypothesis action"], Float[Array, "hypothesis action"]]:
    return jax.vmap(lambda tree: tree.action_bounds(jnp.zeros((), int)))(trees)


def _averages(
    belief: Belief,
    lower: Float[Array, "hypothesis action"],
    upper: Float[Array, "hypothesis action"],
) -> tuple[Float[Array, " action"], Float[Array, " action"]]:
    """Over hypotheses; equal to the last bit where all that have weight are known."""
    weight = belief.weight[:, None]
    has_weight = weight > 0
    low = jnp.sum(jnp.where(has_weight, weight * lower, 0.0), axis=0)
    high = jnp.sum(jnp.where(has_weight, weight * upper, 0.0), axis=0)
    is_known = jnp.all((lower == upper) | ~has_weight, axis=0)
    return low, jnp.where(is_known, low, high)


def _verdict(
    lower: Float[Array, " action"], upper: Float[Array, " action"]
) -> tuple[BoolScalar, BoolScalar]:
    """Whether the best action is known, and whether its value is."""
    best = jnp.argmax(lower + upper)
    others = upper.at[best].set(-jnp.inf)
    return lower[best] >= others.max(), lower[best] >= upper.max()


def _read(belief: Belief, growth: Growth, trees: LazyTree) -> Plan:
    """The plan that grown trees hold."""
    bounds = _root_bounds(trees)
    lower, upper = _averages(belief, *bounds)
    is_solved, is_exact = _verdict(lower, upper)
    index = jnp.argmax(lower + upper)
    q_values = 0.5 * (lower + upper)
    likeliest = belief.likeliest
    tree = jax.tree.map(lambda leaf: leaf[likeliest], trees)
    problem = growth.problem
    width = problem.num_actions * growth.num_samples
    num_model_calls = trees.num_expansions.sum() * width * problem.action_repeat
    num_nodes = jax.vmap(lambda tree: tree.expansions_by_level(growth.depth))(trees)
    counts = trees.num_expansions, trees.num_contradictions
    return Plan(
        index=index,
        action=problem.action(index),
        value=q_values[index],
        q_values=q_values,
        hypothesis_q_values=0.5 * (bounds[0] + bounds[1]),
        sequence=problem.action(tree.best_actions(index, growth.depth)),
        info=SearchInfo(num_model_calls, num_nodes=num_nodes),
        tree=ForwardSearchReport(lower, upper, is_solved, is_exact, *counts),
    )
