r"""Tree search by the optional library mctx, as a planner like the others.

Every hypothesis has a tree of its own, all of them searched side by side; what an
action is worth is the mean over trees. A node's first value is `leaf_fn`, at every
level and not only at the horizon, so a leaf that says zero where costs lie ahead makes
whatever was looked at least look best. Priors are uniform; values are normalised by the
span of a node's actions, as mctx does by default. The noise of a hypothesis at a level
is the same wherever it is reached.

Two ways of choosing where to look: `"gumbel"` (sequential halving at the root; below it
the search soon commits itself to what looked best first) and `"muzero"` (PUCT). Both
report means over what was looked at, not maxima, so an action that few simulations
reached may have any value: the choice is the best mean among actions with at least half
as many visits, averaged over trees, as the most visited.

Costs `num_simulations` steps of the model under each hypothesis, one after the other.
To be preferred where actions are few and the leaf is a good value.

Danihelka et al. (2022), Policy improvement by planning with Gumbel; Schrittwieser et
al. (2020), Mastering Atari, Go, chess and shogi by planning with a learned model.
"""

import importlib
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from boomdp_jax.core.arrays import IntScalar, Key
from boomdp_jax.planning.belief import Belief
from boomdp_jax.planning.plan import Plan, SearchInfo
from boomdp_jax.planning.problem import (
    LeafFn,
    Problem,
    RewardFn,
    TransitionFn,
    check_positive,
    check_state,
    make_problem,
)
from boomdp_jax.planning.rollouts import Rollouts, draw_rollouts, read_inputs

_POLICIES = ("gumbel", "muzero")
# Part of the most visited action's visits that an action needs to be chosen. Sequential
# halving gives finalists twice what the round before them had.
_SMALLEST_VISITS = 0.5


def mctx_search(
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
    num_simulations: int = 256,
    policy: str = "gumbel",
    max_num_considered_actions: int = 16,
) -> Plan:
    """Choose an action by Monte Carlo tree search.

    Compiled once for the same functions and counts; functions made anew for each call
    are compiled anew.

    Args:
        key: random key.
        belief: a `Belief`, a pair `(hypotheses, log_weight)`, or a posterior.
        state: where to plan from; a pytree of numbers.
        transition_fn: the model, as `planning.problem` says.
        reward_fn: what a step pays; finite.
        actions: any pytree with a leading axis `action`, or how many there are.
        depth: levels of a tree at most.
        discount: of one step of the model, in (0, 1].
        action_repeat: steps of the model for which an action is held.
        leaf_fn: first value of every node; none: 0.
        num_hypotheses: how many to plan under at most.
        num_simulations: nodes that each tree expands.
        policy: `"gumbel"` or `"muzero"`.
        max_num_considered_actions: of `"gumbel"`: actions tried at the root at most,
            drawn at random where there are more.

    Returns:
        The plan. Under a hypothesis whose tree did not try an action, it has the value
        of the worst that was tried; −∞ where no tree did. The sequence follows the most
        visited actions of the likeliest hypothesis's tree, below which the last one is
        repeated.

    Raises:
        ImportError: mctx is not installed.
        TypeError: not a belief, or not a function.
        ValueError: a count that is not positive, a discount outside (0, 1], another
            policy, actions or weights that do not fit.
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
    num_simulations = check_positive("num_simulations", num_simulations)
    max_num_considered_actions = check_positive(
        "max_num_considered_actions", max_num_considered_actions
    )
    if policy not in _POLICIES:
        raise ValueError(f"policy: expected one of {_POLICIES}; got {policy!r}")
    try:
        # Looked up by name, since it is optional.
        mctx: Any = importlib.import_module("mctx")
    except ImportError as error:
        raise ImportError(
            "mctx_search: expected mctx, got none; pip install mctx"
        ) from error
    if policy == "muzero":
        search = {"dirichlet_fraction": 0.0}
    else:
        search = {"max_num_considered_actions": max_num_considered_actions}
    return _search(
        key,
        problem,
        belief,
        state,
        mctx,
        policy,
        search,
        depth=depth,
        num_hypotheses=num_hypotheses,
        num_simulations=num_simulations,
    )


@eqx.filter_jit
def _search(
    key: Key,
    problem: Problem,
    belief: Belief,
    state: PyTree,
    mctx: Any,
    policy: str,
    options: dict[str, Any],
    *,
    depth: int,
    num_hypotheses: int,
    num_simulations: int,
) -> Plan:
    rollout_key, search_key = jax.random.split(key)
    rollouts = draw_rollouts(rollout_key, problem, belief, state, depth, num_hypotheses)
    search = mctx.gumbel_muzero_policy if policy == "gumbel" else mctx.muzero_policy
    output = search(
        rollouts,
        search_key,
        _root(mctx, rollouts),
        lambda rollouts, _, index, node: _expand(mctx, rollouts, index, node),
        num_simulations,
        max_depth=depth,
        **options,
    )
    tree = output.search_tree
    visits = tree.children_visits[:, tree.ROOT_INDEX]
    hypothesis_q_values = _completed(tree.summary().qvalues, visits)
    is_tried = jnp.any(visits > 0, axis=0)
    q_values = jnp.where(is_tried, rollouts.mean(hypothesis_q_values.T), -jnp.inf)
    mean_visits = rollouts.mean(visits.T.astype(q_values.dtype))
    is_known = is_tried & (mean_visits >= _SMALLEST_VISITS * jnp.max(mean_visits))
    index = jnp.argmax(jnp.where(is_known, q_values, -jnp.inf))
    likeliest = jnp.argmax(rollouts.weight)
    sequence = problem.action(
        _most_visited(
            tree.children_index[likeliest],
            tree.children_visits[likeliest],
            index,
            depth,
        )
    )
    return Plan(
        index=index,
        action=problem.action(index),
        value=q_values[index],
        q_values=q_values,
        hypothesis_q_values=jnp.where(is_tried[None], hypothesis_q_values, -jnp.inf),
        sequence=sequence,
        info=SearchInfo(_num_calls(rollouts, num_simulations)),
    )


class _Node(eqx.Module):
    """What mctx stores of a node, batched over hypotheses."""

    state: PyTree
    is_alive: Array
    """Not so after the end of the episode."""
    level: Array


def _root(mctx: Any, rollouts: Rollouts) -> Any:
    problem, num = rollouts.problem, rollouts.weight.shape[0]
    state = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf[None], (num, *leaf.shape)), rollouts.state
    )
    return mctx.RootFnOutput(
        prior_logits=_even(rollouts),
        value=jax.vmap(problem.leaf)(rollouts.hypotheses, state),
        embedding=_Node(state, jnp.ones(num, bool), jnp.zeros(num, int)),
    )


def _expand(
    mctx: Any, rollouts: Rollouts, index: Int[Array, " hypothesis"], node: _Node
) -> tuple[Any, _Node]:
    """Take one action in each tree."""

    def one(hypothesis, keys, index, node):
        problem = rollouts.problem
        action = problem.action(index)
        outcome = problem.hold(keys[node.level], hypothesis, node.state, action)
        reward = jnp.where(node.is_alive, outcome.reward, 0.0)
        is_alive = node.is_alive & (outcome.continuation > 0)
        value = jnp.where(is_alive, problem.leaf(hypothesis, outcome.state), 0.0)
        child = _Node(outcome.state, is_alive, node.level + 1)
        return reward, outcome.continuation, value, child

    reward, continuation, value, child = jax.vmap(one)(
        rollouts.hypotheses, rollouts.keys, index, node
    )
    output = mctx.RecurrentFnOutput(
        reward=reward,
        discount=continuation,
        prior_logits=_even(rollouts),
        value=value,
    )
    return output, child


def _even(rollouts: Rollouts) -> Float[Array, "hypothesis action"]:
    """Logits that prefer no action."""
    shape = (rollouts.weight.shape[0], rollouts.problem.num_actions)
    return jnp.zeros(shape, rollouts.problem.discount.dtype)


def _completed(
    value: Float[Array, "hypothesis action"], visits: Int[Array, "hypothesis action"]
) -> Float[Array, "hypothesis action"]:
    """Give actions without a visit the worst value of their tree."""
    is_visited = visits > 0
    worst = jnp.min(value, axis=1, where=is_visited, initial=jnp.inf)
    return jnp.where(is_visited, value, worst[:, None])


def _most_visited(
    children: Int[Array, "node action"],
    visits: Int[Array, "node action"],
    first: IntScalar,
    depth: int,
) -> Int[Array, " level"]:
    """Indices of actions down one tree; where it ends, the last is repeated."""

    def descend(carry, _):
        node, index = carry
        node = jnp.where(node >= 0, children[node, index], node)
        is_expanded = (node >= 0) & (jnp.max(visits[node]) > 0)
        below = jnp.where(is_expanded, jnp.argmax(visits[node]), index)
        return (node, below.astype(index.dtype)), index

    root = jnp.zeros((), children.dtype)
    _, indices = jax.lax.scan(descend, (root, first), length=depth)
    return indices


def _num_calls(rollouts: Rollouts, num_simulations: int) -> IntScalar:
    num_steps = num_simulations * rollouts.problem.action_repeat
    return jnp.asarray(rollouts.weight.shape[0] * num_steps)
