"""Every action from every node of a level: where they lead and what they pay.

A child's random key depends on its path from the root and the number of its draw, not
on its action, so that actions are compared under the same luck, and a node that stands
for merged ones draws what it would have drawn without.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree, UInt32

from boomdp_jax.core.arrays import FloatScalar, Key
from boomdp_jax.planning.belief import Belief, draw_index
from boomdp_jax.planning.problem import Outcome, Problem

Sample = Callable[[Key, PyTree, PyTree], tuple[Outcome, FloatScalar]]
"""From a key, a state and an action: the outcome, and the leaf value where it ends."""


class Nodes(NamedTuple):
    """States of one level that are to be expanded."""

    state: PyTree
    """Leading axis `node`."""
    path: UInt32[Array, " node"]
    """Number of the path from the root, in a tree where nothing is merged."""
    path_return: Float[Array, " node"]
    """What was paid on the way, discounted to the root."""
    exists: Bool[Array, " node"]
    """False for places that are not taken."""


class Children(NamedTuple):
    """What a level's nodes lead to; axis `child` runs over node, action and draw."""

    nodes: Nodes
    """As nodes of the next level; those do not exist after which the episode is over,
    or whose state or reward is not finite."""
    reward: Float[Array, " child"]
    """Of the step that leads there; −∞ where it is not finite."""
    continuation: Float[Array, " child"]
    """What the future counts by; 0 where the episode is over."""
    leaf: Float[Array, " child"]
    """Leaf value there."""


def sample_of_hypothesis(problem: Problem, hypothesis: PyTree) -> Sample:
    """The model under one hypothesis."""

    def sample(key, state, action):
        outcome = problem.hold(key, hypothesis, state, action)
        return outcome, problem.leaf(hypothesis, outcome.state)

    return sample


def sample_of_belief(problem: Problem, belief: Belief) -> Sample:
    """The model with a hypothesis drawn anew for each transition."""

    def sample(key, state, action):
        hypothesis_key, transition_key = jax.random.split(key)
        hypothesis = belief[draw_index(hypothesis_key, belief)]
        return sample_of_hypothesis(problem, hypothesis)(transition_key, state, action)

    return sample


def root_nodes(states: PyTree, dtype: jnp.dtype) -> Nodes:
    """A first level; leading axis of the states `node`."""
    num = jax.tree.leaves(states)[0].shape[0]
    return Nodes(
        states,
        jnp.arange(num, dtype=jnp.uint32),
        jnp.zeros(num, dtype),
        jnp.ones(num, bool),
    )


def expand(
    key: Key,
    problem: Problem,
    sample: Sample,
    nodes: Nodes,
    level_discount: FloatScalar,
    *,
    num_samples: int,
    common_random_numbers: bool,
) -> Children:
    """Try every action in every node.

    Args:
        key: random key of the level.
        problem: actions.
        sample: the model.
        nodes: of the level.
        level_discount: from the root to the level.
        num_samples: draws of each action in each node.
        common_random_numbers: whether actions share their keys.

    Returns:
        Children, `node * action * num_samples` of them.
    """
    num_nodes, num_actions = nodes.exists.shape[0], problem.num_actions
    shape = (num_nodes, num_actions, num_samples)
    action_number = jnp.arange(num_actions, dtype=jnp.uint32)[None, :, None]
    draw = jnp.arange(num_samples, dtype=jnp.uint32)[None, None]
    path = nodes.path[:, None, None]
    number = path * num_samples + draw
    if not common_random_numbers:
        number = number * num_actions + action_number
    keys = jax.vmap(lambda n: jax.random.fold_in(key, n))(_flat(number, shape))

    states = jax.tree.map(lambda leaf: _spread(leaf, shape, 0), nodes.state)
    actions = jax.tree.map(lambda leaf: _spread(leaf, shape, 1), problem.actions)
    outcome, leaf = jax.vmap(sample)(keys, states, actions)

    paid = _flat(nodes.path_return[:, None, None], shape)
    path_return = paid + level_discount * outcome.reward
    is_finite = jnp.isfinite(path_return) & jnp.isfinite(leaf)
    parent_exists = _flat(nodes.exists[:, None, None], shape)
    exists = parent_exists & is_finite & (outcome.continuation > 0)
    path = (path * num_actions + action_number) * num_samples + draw
    below = Nodes(outcome.state, _flat(path, shape), path_return, exists)
    reward = jnp.where(is_finite, outcome.reward, -jnp.inf)
    return Children(below, reward, outcome.continuation, leaf)


def _flat(values: Array, shape: tuple[int, int, int]) -> Array:
    return jnp.broadcast_to(values, shape).reshape(-1)


def _spread(values: Array, shape: tuple[int, int, int], axis: int) -> Array:
    """Repeat along the other two axes of a level's children, and flatten those."""
    rest = values.shape[1:]
    lead = [1, 1, 1]
    lead[axis] = shape[axis]
    spread = jnp.broadcast_to(values.reshape(*lead, *rest), (*shape, *rest))
    return spread.reshape(-1, *rest)
