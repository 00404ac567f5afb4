"""`run`: an agent learns a task, over many seeds, into a folder."""

import argparse
import sys

import numpy as np

from boomdp_jax.agents.episode import EpisodeRecord
from boomdp_jax.experiments.run import Run, begin_run


def run(arguments: argparse.Namespace) -> None:
    """Run the episodes that are missing, and put all together when they are done.

    Args:
        arguments: what `cli.main` parsed.

    Raises:
        ValueError: bad input, or a folder of another run.
    """
    begun = begin_run(
        arguments.task,
        arguments.agent,
        arguments.out,
        num_seeds=arguments.seeds,
        num_steps=arguments.steps,
        noise=arguments.noise,
        world=arguments.world,
    )
    results = fill(begun, arguments.shard)
    if results is None:
        missing = begun.missing()
        print(f"{len(missing)} seeds are missing, of other shards", file=sys.stderr)
        return
    total = results["reward"].sum(axis=1)
    error = total.std(ddof=1) / np.sqrt(len(total)) if len(total) > 1 else np.nan
    print(
        f"{begun.task}, {begun.agent}: return {total.mean():.1f} +- {error:.1f} "
        f"(standard error, {len(total)} seeds); {begun.folder / 'results.npz'}"
    )


def fill(begun: Run, shard: tuple[int, int] | None) -> dict[str, np.ndarray] | None:
    """Run the episodes of a shard that are missing, and say how it goes.

    Args:
        begun: the run.
        shard: as of `Run.missing`; default: all.

    Returns:
        As of `Run.collect`.
    """
    seeds = begun.missing(shard or (0, 1))
    num_done = begun.num_seeds - len(begun.missing())
    if num_done:
        print(f"{num_done} of {begun.num_seeds} were there", file=sys.stderr)
    count = 0

    def report(seed: int, record: EpisodeRecord) -> None:
        nonlocal count
        count += 1
        planning = record.plan_seconds[record.plan_seconds > 0]
        print(
            f"[{'#' * (20 * count // len(seeds)):<20}] {count}/{len(seeds)} "
            f"seed {seed}: {record.num_done} steps, return {record.reward.sum():.1f}, "
            f"{1e3 * np.median(planning):.0f} ms a decision",
            file=sys.stderr,
        )

    begun.run_seeds(seeds, report)
    return begun.collect()
