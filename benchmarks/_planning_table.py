"""Episodes of planners on tasks, depth and macro-step tuned alike, and the table."""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from _planning_rivals import HAS_MCTX, Rival, rivals
from _planning_tasks import TASKS, Task
from _report import Reporter

from boomdp_jax.planning import Belief, certain

TUNING_SEED, NUM_TUNING_STARTS = 500, 8
HORIZONS = (0.5, 2.0)
"""Horizons that tuning tries, over the task's own."""
TIMED_CALLS = 2000
"""Budget at which a planner's speed is found, for rows at equal time."""


class Result(NamedTuple):
    """Of one planner on all starts."""

    returns: np.ndarray
    reached: np.ndarray
    num_calls: int
    """Of a decision."""
    seconds: float
    """Of a decision."""
    compile_seconds: float


def episodes(
    task: Task, plan: Callable, belief: Belief, truths, starts, seed: int
) -> Result:
    """Play from all starts, one after the other, and time the second time."""
    num_decisions = task.num_steps // task.action_repeat

    def step(hypothesis, state, action):
        def one(carry, _):
            state, paid, alive = carry
            moved, done = task.transition_fn(None, hypothesis, state, action)
            paid = paid + alive * task.reward_fn(hypothesis, state, action, moved)
            state = jax.tree.map(
                lambda new, old: jnp.where(alive > 0, new, old), moved, state
            )
            return (state, paid, jnp.where(done, 0.0, alive)), None

        return one

    def play(key, state, truth):
        empty = jax.eval_shape(lambda: plan(key, belief, state, None))
        previous = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), empty)

        def decide(carry, decision_key):
            state, paid, alive, previous = carry
            found = plan(decision_key, belief, state, previous)
            (state, paid, alive), _ = jax.lax.scan(
                step(truth, state, found.action),
                (state, paid, alive),
                None,
                length=task.action_repeat,
            )
            return (state, paid, alive, found), found.info.num_model_calls

        carry = (state, jnp.zeros(()), jnp.ones(()), previous)
        keys = jax.random.split(key, num_decisions)
        (state, paid, _, _), calls = jax.lax.scan(decide, carry, keys)
        return paid, task.is_reached(state), calls.mean()

    num = jax.tree.leaves(starts)[0].shape[0]
    keys = jax.random.split(jax.random.key(seed), num)
    run = jax.jit(lambda *each: jax.lax.map(lambda one: play(*one), each))
    begin = time.perf_counter()
    compiled = run.lower(keys, starts, truths).compile()
    compile_seconds = time.perf_counter() - begin
    begin = time.perf_counter()
    paid, reached, calls = jax.block_until_ready(compiled(keys, starts, truths))
    seconds = (time.perf_counter() - begin) / (num * num_decisions)
    return Result(
        np.asarray(paid),
        np.asarray(reached),
        int(calls.mean()),
        seconds,
        compile_seconds,
    )


def starts_of(task: Task, num: int, seed: int):
    keys = jax.random.split(jax.random.key(1000 + seed), num)
    return jax.vmap(task.starts)(keys)


def repeated(hypothesis, num: int):
    return jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (num, *jnp.shape(leaf))), hypothesis
    )


def report_result(reporter: Reporter, case: str, result: Result) -> None:
    """Return, reached, times, calls a second."""
    num = len(result.returns)
    band = 1.96 * result.returns.std(ddof=1) / np.sqrt(num)
    reporter.report(
        case=case,
        metric="return; spread: 95 % band of the mean",
        value=float(result.returns.mean()),
        n=num,
        spread=float(band),
    )
    reporter.report(
        case=case, metric="share reached", value=float(result.reached.mean()), n=num
    )
    reporter.report(
        case=case,
        metric="time a decision",
        value=1e3 * result.seconds,
        unit="ms",
    )
    reporter.report(
        case=case, metric="time to compile", value=result.compile_seconds, unit="s"
    )
    reporter.report(
        case=case,
        metric="model calls a decision; spread: millions a second",
        value=result.num_calls,
        spread=result.num_calls / result.seconds / 1e6,
    )


def tuned(
    task: Task, leaf: str, num_calls: int, name: str, belief: Belief, seed: int
) -> Task | None:
    """The task with the macro-step and horizon at which a planner does best.

    First the macro-step at the task's own horizon, then the horizon, on starts that
    the table does not use, by mean return. None: too few calls for any.
    """
    starts = starts_of(task, NUM_TUNING_STARTS, seed + TUNING_SEED)
    truths = repeated(task.hypothesis, NUM_TUNING_STARTS)
    horizon = task.depth * task.action_repeat
    tried: dict[tuple[int, int], float] = {}

    def attempt(action_repeat: int, steps: float) -> None:
        depth = max(1, round(steps / action_repeat))
        if (depth, action_repeat) in tried:
            return
        variant = task._replace(depth=depth, action_repeat=action_repeat)
        made = rivals(variant, leaf, num_calls, (name,))
        if made:
            result = episodes(variant, made[0].plan, belief, truths, starts, seed)
            tried[depth, action_repeat] = float(result.returns.mean())

    for action_repeat in task.action_repeats:
        attempt(action_repeat, horizon)
    if not tried:
        return None
    _, best_repeat = max(tried, key=lambda each: tried[each])
    for factor in HORIZONS:
        attempt(best_repeat, factor * horizon)
    depth, action_repeat = max(tried, key=lambda each: tried[each])
    return task._replace(depth=depth, action_repeat=action_repeat)


def rows_of(
    reporter: Reporter, arguments, task: Task, leaf: str, name: str, num_calls: int
) -> None:
    """One planner's rows at a budget; at a time a decision, where that is asked."""
    starts = starts_of(task, arguments.starts, arguments.seed)
    truths = repeated(task.hypothesis, arguments.starts)
    belief = certain(task.hypothesis)
    if arguments.tune:
        found = tuned(task, leaf, num_calls, name, belief, arguments.seed)
        if found is None:
            return
        task = found

    def run(rival: Rival) -> Result:
        return episodes(task, rival.plan, belief, truths, starts, arguments.seed)

    for rival in rivals(task, leaf, num_calls, (name,)):
        shape = f"depth {task.depth} x {task.action_repeat}"
        case = f"{task.name}, {leaf} leaf, {num_calls} calls, {name}, {shape}"
        report_result(reporter, case, run(rival))


def rows_at_equal_time(
    reporter: Reporter, arguments, task: Task, leaf: str, name: str
) -> None:
    """A planner with as many calls as it makes in some milliseconds."""
    starts = starts_of(task, arguments.starts, arguments.seed)
    truths = repeated(task.hypothesis, arguments.starts)
    belief = certain(task.hypothesis)
    for milliseconds in arguments.milliseconds:
        num_calls, result = TIMED_CALLS, None
        # Speed changes with the budget, so that it is found twice.
        for _ in range(3):
            made = rivals(task, leaf, num_calls, (name,))
            if not made:
                break
            result = episodes(
                task, made[0].plan, belief, truths, starts, arguments.seed
            )
            ratio = milliseconds / (1e3 * result.seconds)
            if 0.8 < ratio < 1.25:
                break
            num_calls = max(200, int(num_calls * ratio))
        if result is not None:
            case = f"{task.name}, {leaf} leaf, {milliseconds:g} ms, {name}"
            report_result(reporter, case, result)


def report_table(reporter: Reporter, arguments) -> None:
    """Every planner on every task, leaf and budget, on the true model."""
    for task_name in arguments.tasks:
        task = TASKS[task_name]()
        for leaf in arguments.leaves or task.leaves:
            if leaf not in task.leaves:
                continue
            names = arguments.planners or tuple(
                rival.name for rival in rivals(task, leaf, max(arguments.calls))
            )
            for name in names:
                for num_calls in arguments.calls:
                    rows_of(reporter, arguments, task, leaf, name, num_calls)
                if arguments.milliseconds:
                    rows_at_equal_time(reporter, arguments, task, leaf, name)
    if not HAS_MCTX:
        reporter.report(
            case="mctx", metric="not installed, its rows are left out", value=0
        )
