"""`run`: an agent learns a task, over many seeds, into a folder."""

import argparse
import sys

import numpy as np

from boomdp_jax.agents.episode import EpisodeRecord
from boomdp_jax.agents.namo_episode import NamoRecord
from boomdp_jax.experiments.namo_run import begin_namo
from boomdp_jax.experiments.run import Run, begin_run


def run(arguments: argparse.Namespace) -> None:
    """Run the episodes that are missing, and put all together when they are done.

    Args:
        arguments: what `cli.main` parsed.

    Raises:
        ValueError: bad input, or a folder of another run.
    """
    if arguments.task == "namo":
        _run_namo(arguments)
        return
    for name in ("room", "things", "difficulty", "delay"):
        if getattr(arguments, name) is not None:
            raise ValueError(
                f"--{name}: expected none for {arguments.task}, which is no room to "
                f"choose; got {getattr(arguments, name)}"
            )
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
    print(
        f"{begun.task}, {begun.agent}: return {_with_error(total)}; "
        f"{begun.folder / 'results.npz'}"
    )


def _with_error(total: np.ndarray) -> str:
    """Mean over seeds, and how sure it is; one seed does not tell."""
    if len(total) == 1:
        return f"{total[0]:.1f} (1 seed)"
    error = total.std(ddof=1) / np.sqrt(len(total))
    return f"{total.mean():.1f} +- {error:.1f} (standard error, {len(total)} seeds)"


def _run_namo(arguments: argparse.Namespace) -> None:
    """A robot among furniture, room by room."""
    for name in ("steps", "noise", "world"):
        if getattr(arguments, name) is not None:
            raise ValueError(
                f"--{name}: expected none for namo, got {getattr(arguments, name)}"
            )
    for name in ("things", "difficulty"):
        if arguments.room == "story" and getattr(arguments, name) is not None:
            raise ValueError(
                f"--{name}: expected none with --room story, got "
                f"{getattr(arguments, name)}"
            )
    given = {
        "room": arguments.room,
        "num_things": arguments.things,
        "difficulty": arguments.difficulty,
        "delay": arguments.delay,
    }
    begun = begin_namo(
        arguments.agent,
        arguments.out,
        num_seeds=arguments.seeds,
        **{name: value for name, value in given.items() if value is not None},
    )
    seeds = begun.missing(arguments.shard or (0, 1))
    count = 0

    def report(seed: int, record: NamoRecord) -> None:
        nonlocal count
        count += 1
        end = "solved" if record.is_solved else "not solved"
        print(
            f"[{'#' * (20 * count // len(seeds)):<20}] {count}/{len(seeds)} "
            f"seed {seed}: {end} in {record.seconds:.0f} s, {record.num_pushes} "
            f"pushes, {record.num_wasted} of them wasted",
            file=sys.stderr,
        )

    begun.run_seeds(seeds, report)
    results = begun.collect()
    if results is None:
        missing = len(begun.missing())
        print(f"{missing} seeds are missing, of other shards", file=sys.stderr)
        return
    print(
        f"namo, {begun.agent}: {results['is_solved'].sum()} of {begun.num_seeds} rooms "
        f"solved, {results['num_wasted'].mean():.1f} wasted pushes, "
        f"{results['seconds'].mean():.0f} s; {begun.folder / 'results.npz'}"
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
