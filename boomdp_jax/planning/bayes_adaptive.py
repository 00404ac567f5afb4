r"""A root that counts on learning: the belief is reweighted by what would be seen.

Under hypotheses $h_k$ of weight $w_k$, an action leads from the root to states
$s'_k$. One who sees $s'_k$ believes $w_j \, p(s'_k \mid s, a, h_j)$, and goes on with
one action for all that is still believed:

$$Q(s, a) = \sum_k w_k \left[ r_k + \gamma \max_{a'} \sum_j w'_j(s'_k) \,
  Q_{h_j}(s'_k, a') \right].$$

Below that each hypothesis is planned for alone, as if it were known then. An action
that tells hypotheses apart is thus worth what the right choice afterwards is worth;
without this, trees under one hypothesis each take it for known from the start. The
one-step form of Bayes-adaptive search (Guez, Silver and Dayan 2013, Scalable and
efficient Bayes-adaptive reinforcement learning).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from boomdp_jax.core.arrays import Key
from boomdp_jax.planning.belief import Belief
from boomdp_jax.planning.expansion import expand, root_nodes, sample_of_hypothesis
from boomdp_jax.planning.problem import Problem
from boomdp_jax.planning.risk import without_unknown
from boomdp_jax.planning.tree import Merging, Tree, grow, root_values

LikelihoodFn = Callable[[Any, Any, Any, Any], Any]
"""`(hypothesis, state, action, next_state)` to the log-density of seeing that state at
the end of the held action."""


class Adaptive(NamedTuple):
    """Values at the root, and the trees below what it leads to."""

    q_values: Float[Array, "hypothesis action"]
    """Given the hypothesis that the outcome is drawn from."""
    tree: Tree
    """Below all outcomes, leading axis `hypothesis`."""


def adaptive_values(
    key: Key,
    problem: Problem,
    belief: Belief,
    state: PyTree,
    num_samples: tuple[int, ...],
    merging: Merging,
    likelihood_fn: LikelihoodFn,
    *,
    common_random_numbers: bool,
) -> Adaptive:
    """Values of the root's actions for one who will learn from the first of them.

    Args:
        key: random key.
        problem: model, reward, actions.
        belief: hypotheses that are told apart.
        state: the root.
        num_samples: draws of each action by level; at least two levels.
        merging: which states below are one.
        likelihood_fn: how well a hypothesis explains what is seen.
        common_random_numbers: whether actions are tried under the same luck.

    Returns:
        The values.
    """
    root = root_nodes(jax.tree.map(lambda leaf: leaf[None], state), belief.weight.dtype)
    first_key, later_key = jax.random.fold_in(key, 0), key

    def outcomes(hypothesis):
        return expand(
            first_key,
            problem,
            sample_of_hypothesis(problem, hypothesis),
            root,
            jnp.ones((), problem.discount.dtype),
            num_samples=num_samples[0],
            common_random_numbers=common_random_numbers,
        )

    children = jax.vmap(outcomes)(belief.hypotheses)
    num = belief.num_hypotheses
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), children)
    actions = jax.tree.map(
        lambda leaf: jnp.tile(
            jnp.repeat(leaf, num_samples[0], axis=0), (num,) + (1,) * (leaf.ndim - 1)
        ),
        problem.actions,
    )
    explains = jax.vmap(
        lambda h: jax.vmap(lambda a, s: jnp.asarray(likelihood_fn(h, state, a, s)))(
            actions, flat.nodes.state
        )
    )(belief.hypotheses)
    log_weight = jax.nn.log_softmax(belief.log_weight)[:, None] + explains
    # What no hypothesis explains teaches nothing.
    is_explained = jnp.any(log_weight > -jnp.inf, axis=0)
    prior = jnp.broadcast_to(belief.log_weight[:, None], log_weight.shape)
    weight = jax.nn.softmax(jnp.where(is_explained, log_weight, prior), axis=0)

    def below(hypothesis):
        return grow(
            later_key,
            problem,
            sample_of_hypothesis(problem, hypothesis),
            flat.nodes.state,
            num_samples[1:],
            merging,
            common_random_numbers=common_random_numbers,
            first_level=1,
        )

    tree = jax.vmap(below)(belief.hypotheses)
    known = without_unknown(jax.vmap(root_values)(tree))
    # An outcome of which all was dropped must not veto what led there.
    known = jnp.where(known > -jnp.inf, known, 0.0)
    value = jnp.max(jnp.sum(weight[:, :, None] * known, axis=0), axis=-1)
    goes_on = flat.nodes.exists
    return_ = flat.reward + jnp.where(goes_on, flat.continuation * value, 0.0)
    return_ = return_.reshape(num, problem.num_actions, num_samples[0])
    return Adaptive(jnp.mean(return_, axis=-1), tree)
