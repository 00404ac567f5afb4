r"""How a sparse-sampling tree grows by one node, where its value is least known.

The random key of a transition depends on where in the tree it is and not on when it is
drawn, so every order of growth ends in the same tree. With $A$ actions and $C$ draws,
the transitions out of node $p$ of level $d$ have the keys
`fold_in(fold_in(key, d), p C + c)`, or, where actions do not share their draws,
`fold_in(fold_in(key, d), (p C + c) A + a)`. The root is node 0 of level 0, child
$(a, c)$ of node $p$ is node $p A C + a C + c$ of the next level, modulo $2^{32}$.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, IntScalar, Key
from boomdp_jax.planning.lazy_tree import Family, LazyTree
from boomdp_jax.planning.problem import Outcome, Problem
from boomdp_jax.planning.return_bounds import ReturnBounds


class Growth(eqx.Module):
    """How a tree is grown."""

    problem: Problem
    bounds: ReturnBounds
    depth: int = eqx.field(static=True)
    num_samples: int = eqx.field(static=True)
    common_random_numbers: bool = eqx.field(static=True)

    def plant(self, hypothesis: PyTree, state: PyTree, max_expansions: int) -> LazyTree:
        """A tree of nothing but a root, with room for so many expansions."""
        num_nodes = 1 + max_expansions * self.problem.num_actions * self.num_samples
        dtype = self.problem.discount.dtype
        zeros, numbers = jnp.zeros(num_nodes, dtype), jnp.zeros(num_nodes, jnp.int32)
        lower, upper = self.bounds(hypothesis, state, jnp.asarray(self.depth))
        return LazyTree(
            jax.tree.map(
                lambda leaf: jnp.broadcast_to(leaf, (num_nodes, *leaf.shape)), state
            ),
            level=numbers,
            path=jnp.zeros(num_nodes, jnp.uint32),
            reward=zeros,
            continuation=zeros,
            lower=zeros.at[0].set(lower),
            upper=zeros.at[0].set(upper),
            first_child=numbers,
            num_expansions=jnp.zeros((), jnp.int32),
            num_contradictions=jnp.zeros((), jnp.int32),
            branching=(self.problem.num_actions, self.num_samples),
        )

    def grow(
        self, key: Key, hypothesis: PyTree, tree: LazyTree, action: IntScalar
    ) -> LazyTree:
        """Walk down to one node, expand it, and tell those above.

        Args:
            key: random key of the search, the same in every call.
            hypothesis: the one that the tree is of.
            tree: what has grown so far.
            action: to follow at the root.

        Returns:
            The tree, one expansion larger unless all below `action` is known.
        """
        way = tree.walk(action, self.depth)
        node = way[-1]
        is_unknown = (tree.upper[node] > tree.lower[node]) | (node == 0)
        is_open = is_unknown & (tree.first_child[node] == 0)
        family = self.draw(key, hypothesis, tree, node)
        lower, upper = tree.back_up(way, family, is_open)
        is_wrong = jnp.any(family.lower > family.upper) | _is_wider(
            (lower[-1], upper[-1]), (tree.lower[node], tree.upper[node])
        )
        # All is read before anything is written, or the arrays would be copied.
        way, family, lower, upper, is_open, is_wrong = jax.lax.optimization_barrier(
            (way, family, lower, upper, is_open, is_wrong)
        )
        return tree.attach(way, family, lower, upper, is_open, is_wrong)

    def draw(
        self, key: Key, hypothesis: PyTree, tree: LazyTree, node: IntScalar
    ) -> Family:
        """The children that a node has in the whole tree."""
        num_actions, C = self.problem.num_actions, self.num_samples
        level, path = tree.level[node], tree.path[node]
        state = jax.tree.map(lambda leaf: leaf[node], tree.state)
        level_key = jax.random.fold_in(key, level)

        def child(number):
            action, sample = number // C, number % C
            draw = path * C + sample
            if not self.common_random_numbers:
                draw = draw * num_actions + action
            outcome = self.problem.hold(
                jax.random.fold_in(level_key, draw),
                hypothesis,
                state,
                self.problem.action(action),
            )
            bounds = self.child_bounds(hypothesis, outcome, level + 1)
            return _without_nan(Family(outcome, *bounds))

        return jax.vmap(child)(jnp.arange(num_actions * C, dtype=jnp.uint32))

    def child_bounds(
        self, hypothesis: PyTree, outcome: Outcome, level: IntScalar
    ) -> tuple[FloatScalar, FloatScalar]:
        """What is known of a new node's value."""
        leaf = self.problem.leaf(hypothesis, outcome.state)
        lower, upper = self.bounds(hypothesis, outcome.state, self.depth - level)

        def choose(bound):
            value = jnp.where(level == self.depth, leaf, bound)
            return jnp.where(outcome.continuation > 0, value, 0.0)

        return choose(lower), choose(upper)


def _without_nan(child: Family) -> Family:
    """A child of which a number is not one: the end, at a reward of −∞.

    So it is known to be the worst, and takes no part in any walk.
    """
    outcome, lower, upper = child
    is_sound = jnp.isfinite(outcome.reward) & ~jnp.isnan(lower) & ~jnp.isnan(upper)
    outcome = outcome._replace(
        reward=jnp.where(is_sound, outcome.reward, -jnp.inf),
        continuation=jnp.where(is_sound, outcome.continuation, 0.0),
    )
    return Family(
        outcome, jnp.where(is_sound, lower, 0.0), jnp.where(is_sound, upper, 0.0)
    )


def _is_wider(
    now: tuple[FloatScalar, FloatScalar], before: tuple[FloatScalar, FloatScalar]
) -> BoolScalar:
    """Whether a node's children say less of its value than was told beforehand."""
    rounding = jnp.sqrt(jnp.finfo(before[0].dtype).eps)
    slack = rounding * (jnp.abs(before[0]) + jnp.abs(before[1]))
    return (now[0] < before[0] - slack) | (now[1] > before[1] + slack)
