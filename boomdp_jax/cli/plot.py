"""`plot`: from runs in folders to a figure and a table."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from boomdp_jax.cli.output import check_figure, print_json
from boomdp_jax.experiments.scores import (
    MARKS,
    PUBLISHED,
    LoadedRun,
    Score,
    band_name,
    check_comparable,
    check_is_run,
    load_run,
    mean_band,
    scores,
)


def run(arguments: argparse.Namespace) -> None:
    """Draw what is there, and say it in numbers.

    Args:
        arguments: what `cli.main` parsed.

    Raises:
        ValueError: a folder that is no run, holds no episode, or is of another task.
    """
    folders = [Path(folder) for folder in arguments.runs]
    # Before the figure, which by default goes into the first of them.
    for folder in folders:
        check_is_run(folder)
    path = Path(arguments.out or folders[0] / "curves.png")
    check_figure(str(path))
    report(folders, path, as_json=arguments.json)


def report(
    folders: Sequence[Path], path: Path, *, as_json: bool, title: str | None = None
) -> None:
    """Draw runs, and print their table or JSON lines.

    Args:
        folders: of runs of one setting.
        path: of the figure.
        as_json: one JSON object a run instead of a table.
        title: of the figure; default: the setting.

    Raises:
        ValueError: a folder that is no run, holds no episode, or is of another task.
    """
    from boomdp_jax.viz.learning_curves import plot_curves

    runs = [load_run(folder) for folder in folders]
    check_comparable(runs)
    names = [_name(loaded) for loaded in runs]
    figure = plot_curves(
        {
            name: mean_band(loaded.reward)
            for name, loaded in zip(names, runs, strict=True)
        },
        {
            name: mean_band(loaded.model_error)
            for name, loaded in zip(names, runs, strict=True)
        },
        title=title or runs[0].setting,
        band=band_name(runs),
    )
    figure.savefig(path, dpi=150)
    found = scores(runs)
    if as_json:
        for score in found:
            print_json({"task": runs[0].setting, **score._asdict()})
    else:
        print("\n".join(_table(runs[0], found)))
    print(path, file=sys.stderr)


def _name(loaded: LoadedRun) -> str:
    """Of an agent, with the episodes that are still missing."""
    num, asked = len(loaded.reward), loaded.num_asked
    share = f"{num}" if num == asked else f"{num} of {asked}"
    return f"{loaded.agent} ({share} seed{'s' if asked > 1 else ''})"


def _table(first: LoadedRun, found: list[Score]) -> list[str]:
    """A line for each agent, the best first, and one for each published curve."""
    shares = MARKS.get(first.task, MARKS["cart"])
    marks = " ".join(f"{100 * share:>6.3g}%" for share in shares)
    lines = [
        f"{first.setting}, {first.reward.shape[1]} steps; steps until the mean reward "
        "stays within a share of its first",
        f"{'agent':<32} {'seeds':>5} {'return':>9} {'+-':>7} {'regret':>7} {marks} "
        f"{'plan':>8} {'learn':>8}",
    ]
    for score in found:
        regret = "" if score.regret is None else f"{score.regret:.2f}"
        lines.append(
            f"{score.agent:<32} {score.num_seeds:>5} {score.total:>9.1f} "
            f"{_error(score.total_error)} {regret:>7} {_steps(score.marks)} "
            f"{_milliseconds(score.decision)} {_milliseconds(score.learning)}"
        )
    for published in PUBLISHED.get(first.setting, ()):
        lines.append(
            f"{'published: ' + published.agent:<48} {'':>7} {published.regret:>7.2f} "
            f"{_steps(published.marks)}"
        )
    return lines


def _error(error: float) -> str:
    """Seven characters; one seed does not tell."""
    return f"{'-':>7}" if np.isnan(error) else f"{error:>7.1f}"


def _steps(marks: tuple[int | None, ...]) -> str:
    return " ".join(f"{'-' if step is None else step:>7}" for step in marks)


def _milliseconds(seconds: float) -> str:
    """Eight characters; an episode that is one program has no time of its own parts."""
    return f"{'-':>8}" if np.isnan(seconds) else f"{1e3 * seconds:>5.0f} ms"
