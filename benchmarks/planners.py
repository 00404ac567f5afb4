"""Which planner gets how far, at how many model calls and in what time?

All planners on four tasks, on the true model and on a belief, at equal numbers of model
calls a decision (`--calls`) and in equal time (`--milliseconds`). Starts are drawn at
random and are the same for all; `--tune` finds each planner's depth and macro-step on
others. Before anything is timed, the tree's answer on a tabular case is compared with
backward induction.

Also: the tree's throughput beside that of the bare transition function, memory against
depth, what is kept on overflow by leaf value, and a root that counts on learning.
mctx's rows appear where mctx is installed.
"""

import time
from collections.abc import Callable

import _repository  # noqa: F401
import jax
import jax.numpy as jnp
import numpy as np
from _planning_crates import crates
from _planning_rivals import rivals
from _planning_table import (
    episodes,
    repeated,
    report_result,
    report_table,
    starts_of,
)
from _planning_tasks import TASKS, axle_hypotheses
from _report import Reporter, parser_of

from boomdp_jax.planning import Belief, certain, sparse_sampling
from boomdp_jax.planning.merging import OVERFLOW_POLICIES
from tests.planning.tabular import random_process

PARTS = ("table", "belief", "throughput", "memory", "overflow", "learning")


def main() -> None:
    parser = parser_of(__doc__, quick="pendulum only, 4 starts, the smallest budget")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=tuple(TASKS))
    parser.add_argument("--planners", nargs="+", default=None)
    parser.add_argument("--leaves", nargs="+", default=None)
    parser.add_argument("--starts", type=int, default=24)
    parser.add_argument("--calls", nargs="+", type=int, default=(1000, 4000, 10_000))
    parser.add_argument(
        "--belief-calls",
        type=int,
        default=60_000,
        help="of a decision under sixteen hypotheses, all together",
    )
    parser.add_argument(
        "--milliseconds", nargs="+", type=float, default=(), help="rows at equal time"
    )
    parser.add_argument(
        "--tune", action="store_true", help="find each planner's depth and macro-step"
    )
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.tasks, arguments.starts = ("pendulum",), 4
        arguments.calls, arguments.parts = (1000,), ("table", "throughput")
    reporter = Reporter(arguments.out)
    check_answer()
    parts = {
        "table": report_table,
        "belief": report_belief,
        "throughput": report_throughput,
        "memory": report_memory,
        "overflow": report_overflow,
        "learning": report_learning,
    }
    for name in arguments.parts:
        parts[name](reporter, arguments)
    reporter.print_table()


def check_answer() -> None:
    """The merged tree is backward induction on a process of twenty states."""
    process = random_process(0, 20, 4, is_deterministic=True)
    plan = sparse_sampling(
        jax.random.key(0),
        certain(jnp.zeros(())),
        jnp.asarray(0),
        **process.model(),
        depth=20,
        discount=0.9,
        cell_size=1.0,
    )
    np.testing.assert_allclose(
        plan.q_values, process.q_values(20, 0.9)[0], rtol=1e-4, atol=1e-4
    )


def report_belief(reporter: Reporter, arguments) -> None:
    """Sixteen carts with the axle at either end; the true one is another draw."""
    num = arguments.starts
    task = TASKS["cart"]()
    hypotheses = axle_hypotheses(16, arguments.seed)
    # Weights that favour nothing much, so that the most probable one is often wrong.
    rng = np.random.default_rng([53, arguments.seed])
    log_weight = jnp.asarray(0.3 * rng.standard_normal(16), jnp.float32)
    belief = Belief(hypotheses, log_weight)
    truths = axle_hypotheses(num, arguments.seed + 1)
    starts = starts_of(task, num, arguments.seed)
    num_calls = arguments.belief_calls
    results = {}
    for hypothesis in ("root", "map", "mean", "fresh"):
        share = 16 if hypothesis == "root" else 1
        # Trees of sixteen hypotheses have a sixteenth of the places each.
        planner = rivals(task, "straight", num_calls // share, ("sparse sampling",))[0]
        # Whose plans are followed makes no odds under one hypothesis; under sixteen,
        # each judged by its own best plan, fewer get round the wall.
        options = {"hypotheses": hypothesis, "verify": False}
        plan = _with_options(planner.plan, options)
        results[hypothesis] = episodes(
            task, plan, belief, truths, starts, arguments.seed
        )
        case = f"cart, 16 hypotheses, straight leaf, {hypothesis}"
        report_result(reporter, case, results[hypothesis])
    for other in ("map", "mean", "fresh"):
        gain = results["root"].returns - results[other].returns
        error = gain.std(ddof=1) / np.sqrt(num)
        reporter.report(
            case=f"cart, 16 hypotheses, kept apart against {other}",
            metric="paired gain of return; spread: its standard errors",
            value=float(gain.mean()),
            n=num,
            spread=float(gain.mean() / error),
            target=3.0,
            met=bool(gain.mean() > 3.0 * error),
        )


def _with_options(plan: Callable, options: dict) -> Callable:
    return lambda key, belief, state, previous: plan(
        key, belief, state, previous, **options
    )


def report_throughput(reporter: Reporter, arguments) -> None:
    """The tree beside the bare transition function, as many at once and as often.

    The bare one goes on from its own outcomes inside one compiled loop, so that it
    pays for nothing but itself.
    """
    depth = 32
    for name in arguments.tasks:
        task = TASKS[name]()
        state = task.starts(jax.random.key(0))
        belief = certain(task.hypothesis)
        for capacity in (64, 256, 1024):
            batch = capacity * task.actions.shape[0]
            states = jax.vmap(task.starts)(jax.random.split(jax.random.key(1), batch))
            repeats = (capacity, *(1,) * (task.actions.ndim - 1))
            actions = jnp.tile(task.actions, repeats)
            num_steps = depth * task.action_repeat

            def bare(states, actions, task=task, num_steps=num_steps):
                def one(states, _):
                    states, _ = jax.vmap(
                        lambda s, a: task.transition_fn(None, task.hypothesis, s, a)
                    )(states, actions)
                    return states, None

                return jax.lax.scan(one, states, None, length=num_steps)[0]

            def search(key, state, task=task, belief=belief, capacity=capacity):
                return sparse_sampling(
                    key,
                    belief,
                    state,
                    transition_fn=task.transition_fn,
                    reward_fn=task.reward_fn,
                    actions=task.actions,
                    depth=depth,
                    action_repeat=task.action_repeat,
                    cell_size=jnp.asarray(task.cell_size / 4, jnp.float32),
                    coordinates_fn=task.coordinates_fn,
                    capacity=capacity,
                )

            key = jax.random.key(0)
            bare_seconds, seconds = least_seconds(
                (bare, (states, actions)), (search, (key, state))
            )
            num_calls = int(jax.jit(search)(key, state).info.num_model_calls)
            bare_rate, rate = batch * num_steps / bare_seconds, num_calls / seconds
            case = f"{name}, {capacity} nodes a level, {batch} at once"
            reporter.report(
                case=case,
                metric="model calls a second; peer: the bare transition function",
                value=rate / 1e6,
                unit="M/s",
                peer_value=bare_rate / 1e6,
                target=5.0 if name == "pendulum" else None,
                met=bool(rate >= 5e6) if name == "pendulum" else None,
            )
            reporter.report(
                case=case,
                metric="throughput over the bare one's",
                value=rate / bare_rate,
                target=0.7,
                met=bool(rate >= 0.7 * bare_rate),
            )


def least_seconds(*calls: tuple[Callable, tuple]) -> list[float]:
    """Of fifteen compiled calls each, in turn, after two that are not counted.

    The least, for what else a machine does only adds to it; in turn, so that a busy
    moment meets all of them.
    """
    compiled = [(jax.jit(call), arguments) for call, arguments in calls]
    seconds = np.zeros((17, len(calls)))
    for number in range(17):
        for which, (call, arguments) in enumerate(compiled):
            begin = time.perf_counter()
            jax.block_until_ready(call(*arguments))
            seconds[number, which] = time.perf_counter() - begin
    return seconds[2:].min(axis=0).tolist()


def report_memory(reporter: Reporter, arguments) -> None:
    """Bytes that the compiled search needs, with and without a grid."""
    task = TASKS["point"]()
    belief, state = certain(task.hypothesis), task.starts(jax.random.key(0))
    cases = [("grid", depth) for depth in (8, 16, 32, 64)]
    cases += [("no grid", depth) for depth in (2, 4, 6, 8)]
    for name, depth in cases:
        grid = {"cell_size": 0.2, "capacity": 64} if name == "grid" else {}

        def search(key, state, depth=depth, grid=grid):
            return sparse_sampling(
                key,
                belief,
                state,
                transition_fn=task.transition_fn,
                reward_fn=task.reward_fn,
                actions=task.actions,
                depth=depth,
                coordinates_fn=task.coordinates_fn,
                **grid,
            ).q_values

        compiled = jax.jit(search).lower(jax.random.key(0), state).compile()
        reporter.report(
            case=f"point, {name}, depth {depth}",
            metric="memory of a search",
            value=compiled.memory_analysis().temp_size_in_bytes / 1024,
            unit="KiB",
        )


def report_overflow(reporter: Reporter, arguments) -> None:
    """What is kept where cells are more than places, by leaf value."""
    for name in arguments.tasks:
        if name not in ("point", "cart"):
            continue
        task = TASKS[name]()
        starts = starts_of(task, arguments.starts, arguments.seed)
        truths = repeated(task.hypothesis, arguments.starts)
        belief = certain(task.hypothesis)
        for leaf in task.leaves:
            for policy in OVERFLOW_POLICIES:
                (rival,) = rivals(
                    task, leaf, min(4000, max(arguments.calls)), ("sparse sampling",)
                )
                plan = _with_options(rival.plan, {"overflow": policy})
                result = episodes(task, plan, belief, truths, starts, arguments.seed)
                report_result(reporter, f"{name}, {leaf} leaf, keep {policy}", result)


def report_learning(reporter: Reporter, arguments) -> None:
    """Two crates look alike; one is bolted down, and a nudge tells which."""
    del arguments
    for row in crates():
        reporter.report(**row)


if __name__ == "__main__":
    main()
