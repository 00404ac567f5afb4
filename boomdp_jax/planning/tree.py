r"""Sparse sampling as one array per level: expand, merge, and back values up.

Kearns, Mansour and Ng (2002), A sparse sampling algorithm for near-optimal planning in
large Markov decision processes: with $C$ draws of each action,

$$Q_d(s, a) = \frac1C \sum_c r_c + \gamma V_{d+1}(s'_c), \qquad
  V_d(s) = \max_a Q_d(s, a), \qquad V_H = \text{leaf}.$$

Without a grid the tree is the recursion itself, with $(kC)^d$ nodes at level d. With
one, states of a level in the same cell are one node and a level has a fixed number of
places, so that cost and memory are linear in depth.

A child without a place has no value: it counts as −∞ in a maximum and is left out of
a mean over draws.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, PyTree

from boomdp_jax.core.arrays import IntScalar, Key
from boomdp_jax.planning.expansion import Children, Nodes, Sample, expand, root_nodes
from boomdp_jax.planning.grid import Grid
from boomdp_jax.planning.merging import merge
from boomdp_jax.planning.problem import Problem


class Merging(eqx.Module):
    """When states are the same, and how many of a level are kept."""

    grid: Grid
    strata: Grid
    """Coarser cells, of the policy `"stratified"`."""
    capacity: int = eqx.field(static=True)
    """Places at each level."""
    policy: str = eqx.field(static=True)
    """What is kept where cells are more than places."""


class Shape(NamedTuple):
    """Of one level."""

    num_nodes: int
    num_samples: int
    num_below: int
    """Places at the next level; 0 for leaves."""
    is_merged: bool
    """Whether children share places at all."""

    def as_merged(self) -> "Shape":
        """Leaves as a level of which no more places are kept than it has."""
        return self._replace(num_below=self.num_nodes, is_merged=True)


class Record(NamedTuple):
    """What is kept of a level to back values up."""

    place: Int[Array, "node action sample"]
    """Of each child at the next level; −1 for none."""
    reward: Float[Array, "node action sample"]
    continuation: Float[Array, "node action sample"]
    num_nodes: IntScalar
    num_merged: IntScalar
    num_dropped: IntScalar
    nodes: Nodes | None
    """The level itself, where asked for."""


class Backed(NamedTuple):
    """Values of a level."""

    value: Float[Array, " node"]
    q_values: Float[Array, "node action"]


class Tree(NamedTuple):
    """Records and values; runs of levels of one shape are stacked."""

    records: tuple[Record, ...]
    backed: tuple[Backed, ...]


def level_shapes(
    num_roots: int,
    num_actions: int,
    num_samples: tuple[int, ...],
    merging: Merging | None,
) -> list[Shape]:
    """Shapes of all levels; the children of the root are never merged.

    Merging those would let one action of the root stand for another.
    """
    shapes, num_nodes = [], num_roots
    for level, draws in enumerate(num_samples):
        num_children = num_nodes * num_actions * draws
        is_last = level == len(num_samples) - 1
        is_merged = merging is not None and (level > 0 or num_roots > 1) and not is_last
        num_below = 0 if is_last else num_children
        if merging is not None and is_merged:
            num_below = min(num_children, merging.capacity)
        shapes.append(Shape(num_nodes, draws, num_below, is_merged))
        num_nodes = num_below
    return shapes


def num_model_calls(shapes: list[Shape], problem: Problem) -> int:
    """Calls of `transition_fn`."""
    held = problem.num_actions * problem.action_repeat
    return held * sum(shape.num_nodes * shape.num_samples for shape in shapes)


def runs_of(shapes: list[Shape]) -> list[tuple[Shape, int, int]]:
    """Levels that are alike and follow each other: shape, first level, how many.

    Leaves are like the merged levels above them, so that there is one program for all:
    what is merged of them is of no account.
    """
    runs: list[tuple[Shape, int, int]] = []
    for level, shape in enumerate(shapes):
        like = shape if shape.num_below else shape.as_merged()
        if runs and runs[-1][0] == like and like.num_below == like.num_nodes:
            runs[-1] = (like, runs[-1][1], runs[-1][2] + 1)
        else:
            runs.append((shape, level, 1))
    return runs


def grow(
    key: Key,
    problem: Problem,
    sample: Sample,
    states: PyTree,
    num_samples: tuple[int, ...],
    merging: Merging | None,
    *,
    common_random_numbers: bool = True,
    first_level: int = 0,
    keep_nodes: bool = False,
) -> Tree:
    """Grow the tree below some states, and back its values up.

    Args:
        key: random key.
        problem: actions and discount.
        sample: the model.
        states: leading axis `node`; usually one.
        num_samples: draws of each action, by level.
        merging: which states are one; None: none.
        common_random_numbers: whether actions are tried under the same luck.
        first_level: number of the states' level, of which the random keys are made.
        keep_nodes: whether the records have the states of the levels.

    Returns:
        The tree; values of the given states are `root_values` of it.
    """
    shapes = level_shapes(
        jax.tree.leaves(states)[0].shape[0], problem.num_actions, num_samples, merging
    )
    nodes = root_nodes(states, problem.discount.dtype)
    held_discount = problem.discount**problem.action_repeat

    def descend(shape: Shape, nodes: Nodes, level: Any):
        level_discount = held_discount**level
        expansion_key = jax.random.fold_in(key, level + first_level)
        children = expand(
            expansion_key,
            problem,
            sample,
            nodes,
            level_discount,
            num_samples=shape.num_samples,
            common_random_numbers=common_random_numbers,
        )
        score = children.nodes.path_return
        score = score + level_discount * held_discount * children.leaf
        merge_key = jax.random.fold_in(expansion_key, 0)
        is_last = level == len(shapes) - 1
        below, place, counts = _next_level(
            merge_key, shape, children, score, merging, is_last
        )
        axes = (shape.num_nodes, problem.num_actions, shape.num_samples)
        # Leaves' values are paid at once: there is no level to look them up in.
        reward, continuation = children.reward, children.continuation
        is_leaf = is_last & children.nodes.exists
        reward = reward + jnp.where(is_leaf, continuation * children.leaf, 0.0)
        continuation = jnp.where(is_last, 0.0, continuation)
        record = Record(
            place.reshape(axes),
            reward.reshape(axes),
            continuation.reshape(axes),
            jnp.sum(nodes.exists),
            *counts,
            nodes if keep_nodes else None,
        )
        return below, record

    records = []
    for shape, level, count in runs_of(shapes):
        if count == 1:
            nodes, record = descend(shape, nodes, level)
        else:
            nodes, record = lax.scan(
                lambda carry, number, shape=shape: descend(shape, carry, number),
                nodes,
                jnp.arange(level, level + count),
            )
        records.append(record)
    return Tree(tuple(records), _back_up_all(records, shapes))


def _next_level(
    key: Key,
    shape: Shape,
    children: Children,
    score: Array,
    merging: Merging | None,
    is_last: Any,
):
    """Nodes of the next level, each child's place there, and how many had none."""
    exists = children.nodes.exists
    none = jnp.zeros((), int)
    if not shape.num_below:
        return None, jnp.full(exists.shape, -1), (none, none)
    if not shape.is_merged or merging is None:
        place = jnp.where(exists, jnp.arange(exists.shape[0]), -1)
        return children.nodes, place, (none, none)

    def next_nodes():
        merged = merge(
            key,
            jax.vmap(merging.grid.cell)(children.nodes.state),
            jax.vmap(merging.strata.cell)(children.nodes.state),
            score,
            exists,
            capacity=shape.num_below,
            policy=merging.policy,
        )
        nodes = jax.tree.map(lambda leaf: leaf[merged.child], children.nodes)
        nodes = nodes._replace(exists=merged.exists)
        return nodes, merged.place, (merged.num_merged, merged.num_dropped)

    if isinstance(is_last, bool):
        return next_nodes()
    found = jax.eval_shape(next_nodes)
    nodes, place, (num_merged, num_dropped) = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), found
    )
    nothing = nodes, place - 1, (num_merged, num_dropped)
    return lax.cond(is_last, lambda: nothing, next_nodes)


def back_up(record: Record, below: Float[Array, " below"]) -> Backed:
    """Values of a level from those of the next one."""
    future = jnp.where(record.place >= 0, below[jnp.maximum(record.place, 0)], -jnp.inf)
    is_over = record.continuation <= 0
    future = jnp.where(is_over, 0.0, record.continuation * future)
    return_ = record.reward + future
    is_known = return_ > -jnp.inf
    mean = jnp.sum(jnp.where(is_known, return_, 0.0), axis=-1)
    mean = mean / jnp.maximum(jnp.sum(is_known, axis=-1), 1)
    q_values = jnp.where(jnp.any(is_known, axis=-1), mean, -jnp.inf)
    return Backed(jnp.max(q_values, axis=-1), q_values)


def _back_up_all(records: list[Record], shapes: list[Shape]) -> tuple[Backed, ...]:
    """The same for all levels, from the leaves up."""
    backed = []
    runs = runs_of(shapes)
    # There is nothing below leaves; a loop over them has it of its own shape.
    value = jnp.zeros(max(runs[-1][0].num_below, 1), records[-1].reward.dtype)
    for record, (_, _, count) in zip(reversed(records), reversed(runs), strict=True):
        if count == 1:
            level = back_up(record, value)
            value = level.value
        else:

            def one(below, record):
                level = back_up(record, below)
                return level.value, level

            value, level = lax.scan(one, value, record, reverse=True)
        backed.append(level)
    return tuple(reversed(backed))


def root_values(tree: Tree) -> Float[Array, "node action"]:
    """Values of all actions in the states that the tree was grown below."""
    return tree.backed[0].q_values


def best_sequence(
    tree: Tree, action: IntScalar, node: IntScalar | int = 0
) -> Int[Array, " level"]:
    """Actions that promise most, from a given first one on, along first draws.

    Where the episode is over, or what follows was dropped, the last one is repeated.
    """

    def one(carry, level):
        node, action, is_known = carry
        record, backed, is_first = level
        best = jnp.argmax(backed.q_values[node])
        action = jnp.where(is_known & ~is_first, best, action)
        below = record.place[node, action]
        draw = jnp.argmax(below >= 0)
        is_known = is_known & (below[draw] >= 0)
        return (jnp.maximum(below[draw], 0), action, is_known), action

    carry = (jnp.asarray(node), jnp.asarray(action), jnp.asarray(True))
    actions, is_first = [], jnp.asarray(True)
    for record, backed in zip(tree.records, tree.backed, strict=True):
        if record.place.ndim == 3:
            carry, action = one(carry, (record, backed, is_first))
            actions.append(action[None])
        else:
            carry, run = lax.scan(
                lambda c, x: one(c, (*x, jnp.asarray(False))), carry, (record, backed)
            )
            actions.append(run)
        is_first = jnp.asarray(False)
    return jnp.concatenate(actions)


def counts(tree: Tree) -> tuple[Array, Array, Array]:
    """Nodes, merged and dropped children of each level."""

    def of_all(name: str) -> Array:
        return jnp.concatenate([jnp.atleast_1d(getattr(r, name)) for r in tree.records])

    return of_all("num_nodes"), of_all("num_merged"), of_all("num_dropped")
