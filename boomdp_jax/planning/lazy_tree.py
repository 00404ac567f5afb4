r"""Nodes of a sampled tree, each with bounds of its value.

At the horizon both bounds are the leaf value, elsewhere they are those told beforehand
until the node gets its children, and then
$$L = \max_a \frac{1}{C} \sum_c (r_{ac} + γ_{ac} L_{ac}), \qquad
  U = \max_a \frac{1}{C} \sum_c (r_{ac} + γ_{ac} U_{ac}).$$
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree, UInt32

from boomdp_jax.core.arrays import BoolScalar, IntScalar
from boomdp_jax.planning.problem import Outcome


class Family(NamedTuple):
    """The children of a node, all with a leading axis `child`."""

    outcome: Outcome
    lower: Float[Array, " child"]
    upper: Float[Array, " child"]


class LazyTree(eqx.Module):
    """Nodes in the order in which they were made; the root is the first."""

    state: PyTree
    """Leading axis `node`."""
    level: Int[Array, " node"]
    path: UInt32[Array, " node"]
    """Number of the node in the whole tree's level, modulo 2³²."""
    reward: Float[Array, " node"]
    """On the way from the parent."""
    continuation: Float[Array, " node"]
    """What the node's value counts by; 0 where the episode ended."""
    lower: Float[Array, " node"]
    upper: Float[Array, " node"]
    first_child: Int[Array, " node"]
    """Of a block of children, draws of an action side by side; 0 before expansion."""
    num_expansions: IntScalar
    num_contradictions: IntScalar
    """Expansions whose outcome contradicts the bounds told beforehand."""
    branching: tuple[int, int] = eqx.field(static=True)
    """Actions of a node, and draws of each."""

    def walk(self, action: IntScalar, depth: int) -> Int[Array, " level"]:
        """Nodes from the root to one to be expanded, which is repeated at the end.

        Below the root follows the action of the largest upper bound, and everywhere the
        child whose bounds are furthest apart.
        """

        def descend(node, level):
            best = most_promising(*self.action_bounds(node))
            chosen = jnp.where(level == 0, action, best)
            children = self.children(node)[chosen]
            lower, upper = self.lower[children], self.upper[children]
            # Between two of −∞ there is none, not NaN.
            gap = jnp.where(upper > lower, upper - lower, 0.0)
            child = children[jnp.argmax(self.continuation[children] * gap)]
            child = jnp.where(self.first_child[node] > 0, child, node)
            return child, child

        root = jnp.zeros((), jnp.int32)
        _, nodes = jax.lax.scan(descend, root, jnp.arange(depth - 1))
        return jnp.concatenate([root[None], nodes])

    def children(self, node: IntScalar) -> Int[Array, "action num_samples"]:
        """Where the children of an expanded node are."""
        num_actions, C = self.branching
        offsets = jnp.arange(num_actions * C, dtype=jnp.int32).reshape(self.branching)
        return self.first_child[node] + offsets

    def action_bounds(
        self, node: IntScalar
    ) -> tuple[Float[Array, " action"], Float[Array, " action"]]:
        """Lower and upper bound of each action's return at an expanded node."""
        children = self.children(node)
        edge = self.reward[children], self.continuation[children]
        return _mean_bounds(*edge, self.lower[children], self.upper[children])

    def back_up(
        self,
        way: Int[Array, " level"],
        family: Family,
        is_open: BoolScalar,
    ) -> tuple[Float[Array, " level"], Float[Array, " level"]]:
        """New bounds of the nodes on a way, whose last one has got a family."""

        def ascend(below, node):
            child, lower, upper = below
            children = self.children(node)
            low, high = _mean_bounds(
                self.reward[children],
                self.continuation[children],
                jnp.where(children == child, lower, self.lower[children]),
                jnp.where(children == child, upper, self.upper[children]),
            )
            is_last = node == child
            lower = jnp.where(is_last, lower, low.max())
            upper = jnp.where(is_last, upper, high.max())
            return (node, lower, upper), (lower, upper)

        node = way[-1]
        numbers = (*family.outcome[1:], family.lower, family.upper)
        low, high = _mean_bounds(*(x.reshape(self.branching) for x in numbers))
        lower = jnp.where(is_open, low.max(), self.lower[node])
        upper = jnp.where(is_open, high.max(), self.upper[node])
        _, bounds = jax.lax.scan(ascend, (node, lower, upper), way, reverse=True)
        return bounds

    def attach(
        self,
        way: Int[Array, " level"],
        family: Family,
        lower: Float[Array, " level"],
        upper: Float[Array, " level"],
        is_open: BoolScalar,
        is_wrong: BoolScalar,
    ) -> "LazyTree":
        """Write down the children of the last node of a way, and the way's bounds."""
        node, size = way[-1], family.lower.shape[0]
        # What is written for a node that is not to be expanded is out of every node's
        # reach, and the next expansion writes over it.
        start = 1 + self.num_expansions * size
        first_child = jnp.where(is_open, start, self.first_child[node])

        def write(array, block):
            block = jnp.asarray(block, array.dtype)
            return jax.lax.dynamic_update_slice_in_dim(array, block, start, 0)

        numbers = jnp.arange(size, dtype=jnp.uint32)
        return LazyTree(
            jax.tree.map(write, self.state, family.outcome.state),
            write(self.level, jnp.broadcast_to(self.level[node] + 1, (size,))),
            write(self.path, self.path[node] * size + numbers),
            write(self.reward, family.outcome.reward),
            write(self.continuation, family.outcome.continuation),
            write(self.lower, family.lower).at[way].set(lower),
            write(self.upper, family.upper).at[way].set(upper),
            self.first_child.at[node].set(first_child),
            self.num_expansions + is_open,
            self.num_contradictions + (is_open & is_wrong),
            self.branching,
        )

    def best_actions(self, index: IntScalar, depth: int) -> Int[Array, " level"]:
        """Best actions one after another from one at the root on.

        They follow the first draw of each; where that was not expanded, the last one is
        repeated.
        """

        def descend(carry, _):
            node, index = carry
            child = self.children(node)[index, 0]
            is_expanded = self.first_child[child] > 0
            lower, upper = self.action_bounds(child)
            following = jnp.where(is_expanded, jnp.argmax(lower + upper), index)
            return (jnp.where(is_expanded, child, node), following), index

        carry = (jnp.zeros((), jnp.int32), index)
        return jax.lax.scan(descend, carry, length=depth)[1]

    def expansions_by_level(self, depth: int) -> Int[Array, " level"]:
        """How many nodes of each level have children."""
        return jnp.zeros(depth, int).at[self.level].add(self.first_child > 0)


def most_promising(
    lower: Float[Array, " action"], upper: Float[Array, " action"]
) -> IntScalar:
    """The action of the largest upper bound among those whose return is unknown."""
    return jnp.argmax(jnp.where(upper > lower, upper, -jnp.inf))


def _mean_bounds(
    reward: Float[Array, "action num_samples"],
    continuation: Float[Array, "action num_samples"],
    lower: Float[Array, "action num_samples"],
    upper: Float[Array, "action num_samples"],
) -> tuple[Float[Array, " action"], Float[Array, " action"]]:
    """Bounds of the mean over draws; the same to the last bit where all are known."""
    low = jnp.mean(reward + continuation * lower, axis=1)
    high = jnp.mean(reward + continuation * upper, axis=1)
    return low, jnp.where(jnp.all(lower == upper, axis=1), low, high)
