"""Which planner gets how far, at how many model calls and in what time?

All planners on four tasks, on the true model and on a belief, at equal numbers of model
calls a decision; each row says how long a decision took, so that rows can be compared
at equal time too. Starts are drawn at random and are the same for all. Before anything
is timed, the tree's answer on a tabular case is compared with backward induction.

Also: the tree's throughput beside that of the bare transition function, memory against
depth, what is kept on overflow by leaf value, and a root that counts on learning.
mctx's rows appear where mctx is installed.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import _repository  # noqa: F401
import jax
import jax.numpy as jnp
import numpy as np
from _planning_crates import crates
from _planning_rivals import HAS_MCTX, rivals
from _planning_tasks import TASKS, Task, axle_hypotheses
from _report import Reporter, parser_of

from boomdp_jax.planning import Belief, certain, sparse_sampling
from boomdp_jax.planning.merging import OVERFLOW_POLICIES
from tests.planning.tabular import random_process

PARTS = ("table", "belief", "throughput", "memory", "overflow", "learning")


class Result(NamedTuple):
    """Of one planner on all starts."""

    returns: np.ndarray
    reached: np.ndarray
    num_calls: int
    """Of a decision."""
    seconds: float
    """Of a decision."""
    compile_seconds: float


def main() -> None:
    parser = parser_of(__doc__, quick="pendulum only, 4 starts, the smallest budget")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=tuple(TASKS))
    parser.add_argument("--planners", nargs="+", default=None)
    parser.add_argument("--leaves", nargs="+", default=None)
    parser.add_argument("--starts", type=int, default=24)
    parser.add_argument("--calls", nargs="+", type=int, default=(1000, 4000, 10_000))
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


def report_table(reporter: Reporter, arguments) -> None:
    """Every planner on every task, leaf and budget, on the true model."""
    for name in arguments.tasks:
        task = TASKS[name]()
        starts = starts_of(task, arguments.starts, arguments.seed)
        truths = repeated(task.hypothesis, arguments.starts)
        belief = certain(task.hypothesis)
        for leaf in arguments.leaves or task.leaves:
            if leaf not in task.leaves:
                continue
            for num_calls in arguments.calls:
                for rival in rivals(task, leaf, num_calls, arguments.planners):
                    result = episodes(
                        task, rival.plan, belief, truths, starts, arguments.seed
                    )
                    case = f"{name}, {leaf} leaf, {num_calls} calls, {rival.name}"
                    report_result(reporter, case, result)
    if not HAS_MCTX:
        reporter.report(
            case="mctx", metric="not installed, its rows are left out", value=0
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
    num_calls = max(arguments.calls)
    results = {}
    for hypothesis in ("root", "map", "mean", "fresh"):
        share = 16 if hypothesis == "root" else 1
        # Trees of sixteen hypotheses have a sixteenth of the places each.
        planner = rivals(task, "straight", num_calls // share, ("sparse sampling",))[0]
        options = {"hypotheses": hypothesis}
        if hypothesis == "fresh":
            options["verify"] = False
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
    """The tree beside the bare transition function at the batch of one level."""
    task = TASKS["pendulum"]()
    state = task.starts(jax.random.key(0))
    belief = certain(task.hypothesis)
    for capacity in (64, 256, 1024):
        batch = capacity * task.actions.shape[0]
        states = jax.vmap(task.starts)(jax.random.split(jax.random.key(1), batch))
        actions = jnp.tile(task.actions, (capacity, 1))

        def held(state, action):
            def one(state, _):
                state, _ = task.transition_fn(None, task.hypothesis, state, action)
                return state, None

            return jax.lax.scan(one, state, None, length=task.action_repeat)[0]

        bare = jax.jit(jax.vmap(held))
        bare_seconds = median_seconds(bare, states, actions)
        bare_rate = batch * task.action_repeat / bare_seconds

        def search(key, state, capacity=capacity):
            return sparse_sampling(
                key,
                belief,
                state,
                transition_fn=task.transition_fn,
                reward_fn=task.reward_fn,
                actions=task.actions,
                depth=32,
                action_repeat=task.action_repeat,
                cell_size=jnp.asarray(task.cell_size / 4, jnp.float32),
                coordinates_fn=task.coordinates_fn,
                capacity=capacity,
            )

        run = jax.jit(search)
        key = jax.random.key(0)
        seconds = median_seconds(run, key, state)
        rate = int(run(key, state).info.num_model_calls) / seconds
        case = f"pendulum as a scene, {capacity} nodes a level, {batch} at once"
        reporter.report(
            case=case,
            metric="model calls a second; peer: the bare transition function",
            value=rate / 1e6,
            unit="M/s",
            peer_value=bare_rate / 1e6,
            target=5.0,
            met=bool(rate >= 5e6),
        )
        reporter.report(
            case=case,
            metric="throughput over the bare one's",
            value=rate / bare_rate,
            target=0.7,
            met=bool(rate >= 0.7 * bare_rate),
        )


def median_seconds(call: Callable, *arguments) -> float:
    """Of fifteen calls after the first, which compiles."""
    jax.block_until_ready(call(*arguments))
    seconds = []
    for _ in range(15):
        begin = time.perf_counter()
        jax.block_until_ready(call(*arguments))
        seconds.append(time.perf_counter() - begin)
    return float(np.median(seconds))


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
