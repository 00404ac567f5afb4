"""Sparse sampling over a belief: what to do now, by a tree of sampled futures.

Choose it where a good leaf value is not at hand, where the world is noisy, or where
hypotheses disagree. With a grid (`cell_size`) states that are alike are planned for
once, so that depth costs linearly and not exponentially; it needs cells of about half
a step, held actions of several steps of the model (`action_repeat`), and a horizon that
reaches to where a detour has paid. Without one it is the recursion of Kearns, Mansour
and Ng (2002), whose bounds hold, for a few levels.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from boomdp_jax.core.arrays import Key
from boomdp_jax.planning.bayes_adaptive import LikelihoodFn, adaptive_values
from boomdp_jax.planning.belief import (
    Belief,
    as_belief,
    mean_hypothesis,
    most_probable,
    resample,
)
from boomdp_jax.planning.cell_size import (
    cell_size_from_steps,
    num_calls_for_cell_size,
)
from boomdp_jax.planning.expansion import (
    Sample,
    sample_of_belief,
    sample_of_hypothesis,
)
from boomdp_jax.planning.grid import CoordinatesFn, all_numbers, make_grid
from boomdp_jax.planning.options import Options, check_options, draws_by_level
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
from boomdp_jax.planning.replay import verified_values, with_previous
from boomdp_jax.planning.risk import choose, without_unknown
from boomdp_jax.planning.tree import (
    Merging,
    Tree,
    best_sequence,
    counts,
    grow,
    level_shapes,
    num_model_calls,
    root_values,
)

# Cells of a stratum along each coordinate.
_STRATUM = 4.0
# A tree without a grid grows exponentially; one of more leaves than this is a mistake.
_MOST_LEAVES = 50_000_000


def sparse_sampling(
    key: Key,
    belief: Any,
    state: PyTree,
    *,
    transition_fn: TransitionFn,
    reward_fn: RewardFn,
    actions: PyTree | int,
    depth: int,
    num_samples: int | tuple[int, ...] = 1,
    discount: float | Float[Array, ""] = 1.0,
    action_repeat: int = 1,
    leaf_fn: LeafFn | None = None,
    hypotheses: str = "root",
    num_hypotheses: int = 16,
    likelihood_fn: LikelihoodFn | None = None,
    risk: str = "mean",
    risk_level: float | Float[Array, ""] = 0.25,
    common_random_numbers: bool = True,
    cell_size: Any = None,
    capacity: int = 64,
    coordinates_fn: CoordinatesFn | None = None,
    overflow: str = "stratified",
    stratum_size: Any = None,
    verify: bool = False,
    previous: Plan | None = None,
    keep_tree: bool = False,
) -> Plan:
    """Choose an action by a tree of sampled futures.

    Compiled at the first call, once for each set of functions and static options: pass
    the same function objects again, and arrays rather than numbers for what changes.
    It can be called under `jax.jit` and `jax.vmap`.

    Args:
        key: random key.
        belief: hypotheses and log-weights, in any form that `as_belief` reads.
        state: any pytree.
        transition_fn: `(key, hypothesis, state, action) -> (next_state, done)`.
        reward_fn: `(hypothesis, state, action, next_state) -> reward`.
        actions: pytree with a leading axis `action`, or how many there are.
        depth: levels of the tree.
        num_samples: draws of each action; one number, or one for each level. One is
            enough for a model without noise.
        discount: of one step of the model.
        action_repeat: steps of the model for which an action is held at each level.
        leaf_fn: `(hypothesis, state) -> value` at the horizon; none: 0.
        hypotheses: `"root"`: hypotheses are drawn once and each kept down its own tree
            (posterior sampling); `"fresh"`: drawn anew at every transition of one tree;
            `"map"`: the most probable one (of a posterior the densest draw of its
            likeliest structure); `"mean"`: mean parameters of those that agree with it
            in all but numbers; `"adaptive"`: as `"root"`, for one who will learn from
            the first action's outcome.
        num_hypotheses: how many are drawn for `"root"` and `"adaptive"`; a belief of no
            more is used whole, with its weights.
        likelihood_fn: `(hypothesis, state, action, next_state) -> log-density` of what
            is seen at the end of a held action; for `"adaptive"`.
        risk: what is made of values under several hypotheses: `"mean"`, `"cvar"` over
            the worst part `risk_level` of the belief, or `"worst"`.
        risk_level: part of the belief, in (0, 1].
        common_random_numbers: whether actions are tried under the same luck. Without,
            about eight times the samples are needed for the same choice.
        cell_size: size of the cells on which states are merged, one for each coordinate
            or one for all; infinite for a coordinate that does not tell states apart.
            `"auto"`: half of what one step moves each by, on random actions. None: no
            state is merged.
        capacity: nodes of a level, where there is a grid.
        coordinates_fn: coordinates of a state, as one vector; default: its numbers.
        overflow: which cells are kept where they are more: `"stratified"`, `"bound"`,
            `"gumbel"`, `"random"` or `"first"`.
        stratum_size: of the coarser cells of `"stratified"`; default: four cells.
        verify: whether to follow the best plan that begins with each action from the
            state itself, and compare those returns instead of the tree's values, which
            merging blurs. For models without noise; not for `"fresh"`, `"adaptive"`.
        previous: plan of the decision before, if its first action was carried out for
            `action_repeat` steps: the rest of it is tried again, and counts where it is
            better than what the tree found.
        keep_tree: whether to return the `Tree`, with the states of all levels.

    Returns:
        The plan; leading axis `hypothesis` on all parts of its tree. `q_values` are −∞
        where no action has a finite return under a hypothesis that has weight.

    Raises:
        TypeError: a belief or a function that is none.
        ValueError: an option that is not known or of the wrong size; see the message.
    """
    depth = check_positive("depth", depth)
    check_options(
        depth=depth,
        hypotheses=hypotheses,
        risk=risk,
        risk_level=risk_level,
        overflow=overflow,
        likelihood_fn=likelihood_fn,
        cell_size=cell_size,
        verify=verify,
    )
    num_hypotheses = check_positive("num_hypotheses", num_hypotheses)
    capacity = check_positive("capacity", capacity)
    check_state(state)
    problem = make_problem(
        transition_fn,
        reward_fn,
        actions,
        leaf_fn=leaf_fn,
        discount=discount,
        action_repeat=action_repeat,
    )
    options = Options(
        num_samples=draws_by_level(num_samples, depth),
        hypotheses=hypotheses,
        num_hypotheses=num_hypotheses,
        risk=risk,
        common_random_numbers=common_random_numbers,
        capacity=capacity,
        overflow=overflow,
        verify=verify,
        keep_tree=keep_tree,
    )
    is_auto = isinstance(cell_size, str)
    state = jax.tree.map(jnp.asarray, state)
    merging = None
    if cell_size is not None and not is_auto:
        merging = _merging(coordinates_fn, cell_size, stratum_size, state, options)
    sequence = None if previous is None else previous.sequence
    return _search(
        key,
        as_belief(belief, is_ranked=hypotheses in ("map", "mean")),
        state,
        problem,
        options,
        merging,
        (coordinates_fn or all_numbers, stratum_size) if is_auto else None,
        likelihood_fn,
        jnp.asarray(risk_level, float),
        sequence,
    )


def _merging(
    coordinates_fn: CoordinatesFn | None,
    cell_size: Any,
    stratum_size: Any,
    state: PyTree,
    options: Options,
) -> Merging:
    """Cells and strata, checked against the state."""
    grid = make_grid(coordinates_fn, cell_size, state)
    if stratum_size is None:
        stratum_size = _STRATUM * grid.cell_size
    strata = make_grid(grid.coordinates_fn, stratum_size, state, name="stratum_size")
    return Merging(grid, strata, options.capacity, options.overflow)


@eqx.filter_jit
def _search(
    key: Key,
    belief: Belief,
    state: PyTree,
    problem: Problem,
    options: Options,
    merging: Merging | None,
    auto: tuple[CoordinatesFn, Any] | None,
    likelihood_fn: LikelihoodFn | None,
    risk_level: Float[Array, ""],
    previous: PyTree | None,
) -> Plan:
    """What `sparse_sampling` compiles."""
    # The tree's own key is the caller's, so that its random numbers are those of the
    # recursion; the others are apart from it by numbers that no level has.
    roots = _roots(jax.random.fold_in(key, 0x7FFFFFFF), belief, options)
    num_calls, action_repeat = 0, problem.action_repeat
    if auto is not None:
        cell_size = cell_size_from_steps(
            jax.random.fold_in(key, 0x7FFFFFFE),
            problem,
            sample_of_belief(problem, belief),
            auto[0],
            state,
            len(options.num_samples),
        )
        num_calls += num_calls_for_cell_size(len(options.num_samples), action_repeat)
        merging = _merging(auto[0], cell_size, auto[1], state, options)
    num_calls += _calls_of_trees(problem, options, roots.num_hypotheses, merging)

    if options.hypotheses == "adaptive":
        assert likelihood_fn is not None
        assert merging is not None
        found = adaptive_values(
            key,
            problem,
            roots,
            state,
            options.num_samples,
            merging,
            likelihood_fn,
            common_random_numbers=options.common_random_numbers,
        )
        values, tree = found.q_values, found.tree
    else:
        tree = _trees(key, problem, roots, belief, state, merging, options)
        values = jax.vmap(root_values)(tree)[:, 0]
    follow_key = jax.random.fold_in(key, 0x7FFFFFFD)
    num_followed = roots.num_hypotheses * len(options.num_samples) * action_repeat
    if options.verify:
        values = verified_values(follow_key, problem, roots, state, tree)
        num_calls += num_followed * problem.num_actions
    values = without_unknown(values)
    if previous is not None:
        values = with_previous(key, problem, roots, state, values, previous)
        # Of a hypothesis under which it alone is known, the others are still unknown.
        values = without_unknown(values)
        num_calls += (
            roots.num_hypotheses * len(options.num_samples) * (problem.action_repeat)
        )
    index, q_values = choose(
        values, roots.weight, measure=options.risk, level=risk_level
    )
    return Plan(
        index=index,
        action=problem.action(index),
        value=q_values[index],
        q_values=q_values,
        hypothesis_q_values=values,
        sequence=_sequence(problem, tree, roots, index, options),
        info=_info(tree, num_calls, merging),
        tree=tree if options.keep_tree else None,
    )


def _roots(key: Key, belief: Belief, options: Options) -> Belief:
    """The hypotheses that have a tree of their own."""
    if options.hypotheses == "mean":
        return mean_hypothesis(belief)
    # Of "fresh" none is used but by `previous` and by the chosen sequence.
    if options.hypotheses in ("map", "fresh"):
        return most_probable(belief)
    return resample(key, belief, options.num_hypotheses)


def _trees(
    key: Key,
    problem: Problem,
    roots: Belief,
    belief: Belief,
    state: PyTree,
    merging: Merging | None,
    options: Options,
) -> Tree:
    """One tree for each hypothesis, all with the same random numbers."""
    states = jax.tree.map(lambda leaf: leaf[None], state)

    def below(sample: Sample) -> Tree:
        return grow(
            key,
            problem,
            sample,
            states,
            options.num_samples,
            merging,
            common_random_numbers=options.common_random_numbers,
            keep_nodes=options.keep_tree,
        )

    if options.hypotheses == "fresh":
        tree = below(sample_of_belief(problem, belief))
        return jax.tree.map(lambda leaf: leaf[None], tree)
    return jax.vmap(lambda h: below(sample_of_hypothesis(problem, h)))(roots.hypotheses)


def _calls_of_trees(
    problem: Problem, options: Options, num_roots: int, merging: Merging | None
) -> int:
    """Calls of the model in all trees."""
    draws, num_actions = options.num_samples, problem.num_actions
    if options.hypotheses == "adaptive":
        num_outcomes = num_roots * num_actions * draws[0]
        below = level_shapes(num_outcomes, num_actions, draws[1:], merging)
        first = num_actions * draws[0] * problem.action_repeat
        return num_roots * (first + num_model_calls(below, problem))
    shapes = level_shapes(1, num_actions, draws, merging)
    leaves = shapes[-1].num_nodes * num_actions * draws[-1]
    if leaves > _MOST_LEAVES:
        raise ValueError(
            f"depth: {len(draws)} levels of {num_actions} actions and {draws} draws "
            f"make a tree of {leaves:.1e} leaves; give a cell_size, so that states are "
            "merged"
        )
    return num_roots * num_model_calls(shapes, problem)


def _sequence(
    problem: Problem, tree: Tree, roots: Belief, index: Array, options: Options
) -> PyTree:
    """Actions under the likeliest hypothesis."""
    best = roots.likeliest
    likeliest = jax.tree.map(lambda leaf: leaf[best], tree)
    if options.hypotheses != "adaptive":
        return problem.action(best_sequence(likeliest, index))
    # Below the outcome of that action under that hypothesis, its first draw.
    draws = options.num_samples[0]
    node = (best * problem.num_actions + index) * draws
    second = jnp.argmax(root_values(likeliest)[node])
    rest = best_sequence(likeliest, second, node)
    return problem.action(jnp.concatenate([index[None], rest]))


def _info(tree: Tree, num_calls: int, merging: Merging | None) -> SearchInfo:
    num_nodes, num_merged, num_dropped = jax.vmap(counts)(tree)
    return SearchInfo(
        jnp.asarray(num_calls),
        num_nodes,
        num_merged,
        num_dropped,
        None if merging is None else merging.grid.cell_size,
    )
