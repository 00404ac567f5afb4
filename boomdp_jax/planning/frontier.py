"""The search for a path, a batch of expansions at a time.

All actions of the best open nodes are tried; what they lead to is either a goal, of
which the best is remembered, or a node that may be opened in its turn.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from boomdp_jax.core.arrays import BoolScalar, IntScalar, Key
from boomdp_jax.planning.cell_table import empty_table
from boomdp_jax.planning.grid import Grid
from boomdp_jax.planning.path_nodes import Nodes, OpenList, Tally, Target, admit
from boomdp_jax.planning.problem import Problem

# Two thirds of the table stay empty at least, so that chains of taken slots are short.
_SLOTS_PER_NODE = 3
_UNLIMITED = 2**30


class Search(NamedTuple):
    """What is carried from one batch to the next."""

    nodes: Nodes
    num_nodes: IntScalar
    open_list: OpenList
    goal: Target
    """The best one; node 0 if none is known."""
    batch: Int[Array, " expanded"]
    """The best open nodes."""
    batch_priority: Float[Array, " expanded"]
    num_expansions: IntScalar


class Frontier(eqx.Module):
    """How a search goes on."""

    problem: Problem
    grid: Grid
    depth: int | None = eqx.field(static=True)
    """Level from which on nothing is expanded."""
    max_expansions: int = eqx.field(static=True)
    num_expanded_at_once: int = eqx.field(static=True)
    table_size: int | None = eqx.field(static=True)
    """Slots; none: in proportion to the nodes."""
    max_probes: int = eqx.field(static=True)

    def start(self, hypothesis: PyTree, state: PyTree) -> Search:
        """A search with only the first node open.

        The first node's cell is not in the table, so that an action that does not leave
        it still makes a node, and there is an action to choose.
        """
        size = self.max_expansions + self.num_expanded_at_once - 1
        num_nodes = 1 + size * self.problem.num_actions
        dtype = self.problem.discount.dtype
        zeros, numbers = jnp.zeros(num_nodes, dtype), jnp.zeros(num_nodes, jnp.int32)
        nodes = Nodes(
            jax.tree.map(
                lambda leaf: (
                    jnp.zeros((num_nodes, *leaf.shape), leaf.dtype).at[0].set(leaf)
                ),
                state,
            ),
            cell=jnp.zeros((num_nodes, *self.grid.cell_size.shape), jnp.int32),
            path_return=zeros,
            continuation=zeros.at[0].set(1.0),
            leaf=zeros.at[0].set(self.problem.leaf(hypothesis, state)),
            level=numbers,
            parent=numbers,
            action=numbers,
        )
        nowhere = Target(numbers[0], zeros[0] - jnp.inf, zeros[0] - jnp.inf)
        open_list = OpenList(
            jnp.full(num_nodes, -jnp.inf, dtype),
            empty_table(
                self.table_size or _SLOTS_PER_NODE * num_nodes, self.max_probes
            ),
            nowhere,
            Tally(*(jnp.zeros((), jnp.int32) for _ in Tally._fields)),
        )
        ranks = jnp.arange(self.num_expanded_at_once, dtype=jnp.int32)
        return Search(
            nodes,
            jnp.ones((), jnp.int32),
            open_list,
            nowhere,
            batch=jnp.zeros_like(ranks),
            batch_priority=jnp.where(ranks == 0, 0.0, -jnp.inf).astype(dtype),
            num_expansions=jnp.zeros((), jnp.int32),
        )

    def goes_on(self, search: Search) -> BoolScalar:
        """Whether an open node promises more than the best goal, and budget is left."""
        is_worth_it = search.batch_priority[0] > search.goal.merit
        return is_worth_it & (search.num_expansions < self.max_expansions)

    def advance(self, key: Key, hypothesis: PyTree, search: Search) -> Search:
        """Expand the best open nodes.

        Args:
            key: random key of the search, the same in every call.
            hypothesis: what the world is taken to be.
            search: so far.

        Returns:
            The search, up to `num_expanded_at_once` expansions later.
        """
        left = self.max_expansions - search.num_expansions
        is_used = (search.batch_priority > search.goal.merit) & (
            jnp.arange(self.num_expanded_at_once) < left
        )
        children, is_goal, is_sound = self.expand(key, hypothesis, search)
        # All is read before anything is written, or the arrays would be copied.
        children, is_goal, is_sound = jax.lax.optimization_barrier(
            (children, is_goal, is_sound)
        )
        # Used ones come first, so what is unused is written over by the next batch.
        nodes = jax.tree.map(
            lambda array, block: jax.lax.dynamic_update_slice_in_dim(
                array, block.astype(array.dtype), search.num_nodes, 0
            ),
            search.nodes,
            children,
        )
        num_actions = self.problem.num_actions
        is_new = jnp.repeat(is_used, num_actions) & is_sound
        numbers = search.num_nodes + jnp.arange(is_new.shape[0], dtype=jnp.int32)
        depth = _UNLIMITED if self.depth is None else self.depth
        open_list = search.open_list.close(search.batch, is_used)
        open_list = admit(open_list, nodes, numbers, is_new & ~is_goal, depth)
        batch_priority, batch = _best(open_list.priority, self.num_expanded_at_once)
        num_used = jnp.sum(is_used, dtype=jnp.int32)
        return Search(
            nodes,
            search.num_nodes + num_used * num_actions,
            open_list,
            _best_goal(search.goal, children, numbers, is_new & is_goal),
            batch,
            batch_priority,
            search.num_expansions + num_used,
        )

    def expand(
        self, key: Key, hypothesis: PyTree, search: Search
    ) -> tuple[Nodes, Bool[Array, " child"], Bool[Array, " child"]]:
        """Try all actions at the nodes of a batch.

        Returns:
            Their children, one node's side by side; whether they are goals; and whether
            all about them is finite.
        """
        problem, nodes = self.problem, search.nodes

        def child(node, action):
            state = jax.tree.map(lambda leaf: leaf[node], nodes.state)
            outcome = problem.hold(
                jax.random.fold_in(key, node), hypothesis, state, problem.action(action)
            )
            is_goal = outcome.continuation == 0
            leaf = jnp.where(is_goal, 0.0, problem.leaf(hypothesis, outcome.state))
            path_return = nodes.path_return[node] + (
                nodes.continuation[node] * outcome.reward
            )
            made = Nodes(
                outcome.state,
                self.grid.cell(outcome.state),
                path_return,
                nodes.continuation[node] * outcome.continuation,
                leaf,
                nodes.level[node] + 1,
                node,
                action,
            )
            where = self.grid.coordinates(outcome.state)
            is_sound = jnp.isfinite(path_return + leaf) & jnp.all(jnp.isfinite(where))
            return made, is_goal, is_sound

        actions = jnp.arange(problem.num_actions, dtype=jnp.int32)
        each_action = jax.vmap(child, in_axes=(None, 0))
        found = jax.vmap(each_action, in_axes=(0, None))(search.batch, actions)
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), found)


def _best(
    priority: Float[Array, " node"], num: int
) -> tuple[Float[Array, " expanded"], Int[Array, " expanded"]]:
    """The largest priorities and where they are, in order; of equal ones the newest.

    So the search goes deep where all paths promise the same. By rows, since a row's
    maximum costs little where its position costs much.
    """
    size = priority.shape[0]
    width = math.isqrt(size) + 1
    rows = jnp.pad(priority[::-1], (0, width**2 - size), constant_values=-jnp.inf)
    rows = rows.reshape(width, width)

    def take(carry, _):
        rows, largest = carry
        row = jnp.argmax(largest)
        column = jnp.argmax(rows[row])
        rest = rows[row].at[column].set(-jnp.inf)
        node = jnp.maximum(size - 1 - (row * width + column), 0).astype(jnp.int32)
        left = rows.at[row].set(rest), largest.at[row].set(rest.max())
        return left, (largest[row], node)

    return jax.lax.scan(take, (rows, rows.max(axis=1)), length=num)[1]


def _best_goal(
    goal: Target,
    children: Nodes,
    numbers: Int[Array, " child"],
    is_goal: Bool[Array, " child"],
) -> Target:
    path_return = jnp.where(is_goal, children.path_return, -jnp.inf)
    best = jnp.argmax(path_return)
    other = Target(numbers[best], path_return[best], path_return[best])
    return jax.tree.map(
        lambda a, b: jnp.where(other.merit > goal.merit, a, b), other, goal
    )
