"""Planners of the table, each sized to a number of model calls a decision."""

import importlib.util
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from _planning_task import NUM_LEAF_STEPS
from _planning_tasks import Task

from boomdp_jax import planning

HAS_MCTX = importlib.util.find_spec("mctx") is not None


class Rival(NamedTuple):
    """A planner for one task, leaf and budget."""

    name: str
    plan: Callable
    """`(key, belief, state, previous)` to a plan; `previous` may be ignored."""
    reuses: bool
    """Whether it takes the plan of the decision before."""


def rivals(
    task: Task, leaf: str, num_calls: int, names: tuple[str, ...] | None = None
) -> list[Rival]:
    """All planners at about one budget."""
    held = task.action_repeat
    per_sequence = task.depth * held
    num_actions = task.actions.shape[0]
    common = {
        "transition_fn": task.transition_fn,
        "reward_fn": task.reward_fn,
        "actions": task.actions,
        "leaf_fn": task.leaves[leaf],
        "action_repeat": held,
        "depth": task.depth,
    }
    grid = {
        "cell_size": jnp.asarray(task.cell_size, jnp.float32),
        "coordinates_fn": task.coordinates_fn,
    }
    made = {
        "sparse sampling": (
            planning.sparse_sampling,
            {
                **grid,
                "stratum_size": jnp.asarray(task.stratum_size, jnp.float32),
                "capacity": largest_capacity(task, num_calls),
                "verify": True,
            },
            True,
        ),
        "random shooting": (
            planning.random_shooting,
            {"num_samples": num_calls // per_sequence},
            False,
        ),
        "CEM": (
            planning.cross_entropy_method,
            {"num_samples": max(8, num_calls // per_sequence // 4)},
            True,
        ),
        "CEM, listed actions": (
            planning.cross_entropy_method,
            {
                "num_samples": max(8, num_calls // per_sequence // 4),
                "continuous": False,
            },
            True,
        ),
        "MPPI": (planning.mppi, {"num_samples": num_calls // per_sequence}, True),
        "gradient": (
            planning.gradient_shooting,
            {"num_starts": 8, "num_steps": max(1, num_calls // per_sequence // 8)},
            True,
        ),
        "A* on MAP": (
            planning.a_star,
            {
                **grid,
                "depth": None,
                "max_expansions": max(1, num_calls // (num_actions * held)),
                "max_plan_length": task.depth,
            },
            False,
        ),
        "forward search": (
            planning.forward_search_sparse_sampling,
            {
                "value_bounds": (-task.cost_bound, 0.0),
                "leaf_bounds": (-NUM_LEAF_STEPS * task.cost_bound, 0.0),
                "max_expansions": max(1, num_calls // (num_actions * held)),
            },
            False,
        ),
        "mctx Gumbel": (
            getattr(planning, "mctx_search", None),
            {"num_simulations": num_calls // held, "policy": "gumbel"},
            False,
        ),
        "mctx PUCT": (
            getattr(planning, "mctx_search", None),
            {"num_simulations": num_calls // held, "policy": "muzero"},
            False,
        ),
    }
    chosen = names or tuple(made)
    if unknown := set(chosen) - set(made):
        raise SystemExit(
            f"--planners: expected some of {sorted(made)}, got {sorted(unknown)}"
        )
    return [
        Rival(name, _called(planner, {**common, **options}, reuses), reuses)
        for name, (planner, options, reuses) in made.items()
        if name in chosen and (HAS_MCTX or not name.startswith("mctx"))
    ]


def largest_capacity(task: Task, num_calls: int) -> int:
    """Nodes a level of the widest tree that keeps to a budget; at least one.

    Following the plans of all actions, and the one before, is paid for.
    """
    num_actions, held = task.actions.shape[0], task.action_repeat
    left = num_calls - (num_actions + 1) * task.depth * held
    # The root and its children, none of which is merged.
    left -= num_actions * held * (1 + num_actions * (task.depth > 1))
    num_levels = max(1, task.depth - 2)
    return max(1, left // (num_actions * held * num_levels))


def _called(planner: Callable, options: dict, reuses: bool) -> Callable:
    """The planner with its options, and the plan before where it wants that."""

    def plan(key, belief, state, previous, **others):
        if reuses:
            others["previous"] = previous
        return planner(key, belief, state, **{**options, **others})

    return plan
