r"""The best path to a goal, by A* over cells of continuous coordinates.

States are what the model makes of them; cells only say which states count as the same.
Open is what was reached and not yet expanded; the node of the largest $G + Γ V$ is
expanded next, with $G$ the return of the path to it, $Γ$ what later rewards count by
and $V$ the leaf value, until a goal promises as much as any open node. If $V$ is
nowhere too small, no path over the grid's representatives earns more.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from boomdp_jax.core.arrays import BoolScalar, IntScalar, Key
from boomdp_jax.planning.belief import Belief, as_belief, most_probable
from boomdp_jax.planning.frontier import Frontier
from boomdp_jax.planning.grid import make_grid
from boomdp_jax.planning.path_nodes import actions_to
from boomdp_jax.planning.plan import Plan, SearchInfo
from boomdp_jax.planning.problem import (
    LeafFn,
    RewardFn,
    TransitionFn,
    check_positive,
    check_state,
    make_problem,
)


class PathReport(NamedTuple):
    """How a search for a path went; what `Plan.tree` holds after one."""

    is_found: BoolScalar
    """The plan leads to a goal."""
    is_best: BoolScalar
    """And no open node promised more; False where the budget was spent."""
    plan_length: IntScalar
    """Actions on the path; if more than `max_plan_length`, `sequence` has the first."""
    num_expansions: IntScalar
    """Nodes of which all actions were tried."""
    num_merged: IntScalar
    """Children in a cell that was known."""
    num_reopened: IntScalar
    """Of these, those on a better path to a cell that had been expanded."""
    num_overflowed: IntScalar
    """Children for whose cell the table had no room, so that it forgot another one.
    What is forgotten may be expanded again: no path is lost, but time is."""


def a_star(
    key: Key,
    belief: Any,
    state: PyTree,
    *,
    transition_fn: TransitionFn,
    reward_fn: RewardFn,
    actions: PyTree | int,
    cell_size: float | np.ndarray | Float[Array, ""] | Float[Array, " channel"],
    depth: int | None = None,
    coordinates_fn: Callable[[Any], Any] | None = None,
    max_expansions: int = 4096,
    max_plan_length: int = 256,
    num_expanded_at_once: int = 1,
    table_size: int | None = None,
    max_probes: int = 16,
    discount: float | Float[Array, ""] = 1.0,
    action_repeat: int = 1,
    leaf_fn: LeafFn | None = None,
    num_hypotheses: int = 1,
) -> Plan:
    """Plan a path to a goal, under the most probable hypothesis alone.

    A goal is a state for which `transition_fn` says done. One representative is kept of
    each cell, that of the best path; where a better one is found after the cell was
    expanded, the cell is opened again. Rewards are thought to be negative, since where
    they are not a detour pays for ever; a reward of −∞ forbids a step.

    To be preferred to sampling where the model is known, has no noise and has a goal,
    and the leaf value leads there: with a leaf value of nothing, or one that leads
    astray, it visits every cell that is cheaper to reach than the goal. It takes
    `num_actions` times the expansions in model calls, one batch after another. Over
    many states `jax.lax.map` is several times faster on a processor than `jax.vmap`,
    which copies all arrays in every round. Hart, Nilsson and Raphael (1968), "A formal
    basis for the heuristic determination of minimum cost paths".

    Args:
        key: random key; one draw stands for each transition, the same for all actions
            from a node.
        belief: what is known of the world, in any form that `Belief` has.
        state: where to plan from.
        transition_fn: `(key, hypothesis, state, action) -> (next_state, done)`.
        reward_fn: `(hypothesis, state, action, next_state) -> reward`.
        actions: pytree with a leading axis `action`, or how many there are.
        cell_size: of the grid, in units of the coordinates, one number or one for each.
            About what one action displaces, or half of it; far less, and no two paths
            meet, far more, and actions lead nowhere.
        depth: longest path in actions; none: any. With a limit, a path that is better
            but longer may supersede the only one that is short enough.
        coordinates_fn: `state -> [channel]`, of which equal cells count as the same
            state; none: all numbers in the state.
        max_expansions: bounds time and memory; so many nodes times actions are stored.
        max_plan_length: of `sequence`.
        num_expanded_at_once: best open nodes that are expanded together; more are
            faster where the model is slow, and waste some calls.
        table_size: slots of the hash table of cells; none: thrice as many as nodes.
        max_probes: slots that are looked at for a cell.
        discount: of one step of the model, in (0, 1].
        action_repeat: steps of the model for which an action is held.
        leaf_fn: `(hypothesis, state) -> value`, the return to be expected from a state
            on; none: 0. Where it is less than the true one, the path found need not be
            the best.
        num_hypotheses: as other planners have it; one is planned for all the same.

    Returns:
        The plan. `sequence` are `max_plan_length` actions, the last one repeated beyond
        the goal; `tree` is a `PathReport`. If no goal is found, they lead to the state
        of the largest leaf value, and of those to the one of the best path: what is
        nearest to the goal, as far as is known. `value` is the return of the path and
        the leaf value at its end. There are no `q_values`.

    Raises:
        TypeError: an argument that should be a function or a belief is none.
        ValueError: a count or `cell_size` that is not positive, coordinates that are
            not a vector, another number of cell sizes than of coordinates, no action, a
            discount outside (0, 1].
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
    depth = None if depth is None else check_positive("depth", depth)
    max_expansions = check_positive("max_expansions", max_expansions)
    max_plan_length = check_positive("max_plan_length", max_plan_length)
    num_expanded_at_once = check_positive("num_expanded_at_once", num_expanded_at_once)
    if table_size is not None:
        table_size = check_positive("table_size", table_size)
    max_probes = check_positive("max_probes", max_probes)
    check_positive("num_hypotheses", num_hypotheses)
    state = jax.tree.map(jnp.asarray, state)
    frontier = Frontier(
        problem,
        make_grid(coordinates_fn, cell_size, state),
        depth,
        max_expansions,
        num_expanded_at_once,
        table_size,
        max_probes,
    )
    return _search(
        key, as_belief(belief, is_ranked=True), state, frontier, max_plan_length
    )


@eqx.filter_jit
def _search(
    key: Key, belief: Belief, state: PyTree, frontier: Frontier, max_plan_length: int
) -> Plan:
    """Move the frontier until a goal is the best there is, and read the path off."""
    hypothesis = most_probable(belief)[0]
    search = jax.lax.while_loop(
        lambda search: frontier.goes_on(search),
        lambda search: frontier.advance(key, hypothesis, search),
        frontier.start(hypothesis, state),
    )
    nodes, problem = search.nodes, frontier.problem
    is_found = search.goal.node > 0
    end = jnp.where(is_found, search.goal.node, search.open_list.nearest.node)
    indices = actions_to(nodes, end, max_plan_length)
    calls = problem.num_actions * problem.action_repeat
    return Plan(
        index=indices[0],
        action=problem.action(indices[0]),
        value=nodes.score(end),
        q_values=None,
        hypothesis_q_values=None,
        sequence=problem.action(indices),
        info=SearchInfo(
            search.num_expansions * calls, cell_size=frontier.grid.cell_size
        ),
        tree=PathReport(
            is_found,
            is_found & (search.batch_priority[0] <= search.goal.merit),
            nodes.level[end],
            search.num_expansions,
            *search.open_list.tally,
        ),
    )
