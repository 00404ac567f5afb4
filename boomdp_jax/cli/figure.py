"""`figure`: a figure of the papers, from nothing or from what is there already."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from boomdp_jax.cli.output import print_json
from boomdp_jax.cli.plot import report
from boomdp_jax.cli.run import fill
from boomdp_jax.core.npz_file import read_npz, write_npz
from boomdp_jax.experiments.figures import FIGURES, Figure
from boomdp_jax.experiments.registry import make_task
from boomdp_jax.experiments.sample_curves import SIZES, SampleErrors, sample_errors
from boomdp_jax.experiments.scores import mean_band

_LEARNERS = ("lr", "lwr", "physics")
_TASK = "pendulum"


def run(arguments: argparse.Namespace) -> None:
    """Run what is missing of some figures, and draw them.

    Args:
        arguments: what `cli.main` parsed.

    Raises:
        ValueError: bad input, or a folder of other runs.
    """
    folder = Path(arguments.out)
    folder.mkdir(parents=True, exist_ok=True)
    for name in arguments.names:
        print(f"figure {name}", file=sys.stderr)
        if name == "1a":
            _draw_samples(arguments, folder)
        else:
            _draw_runs(arguments, folder, name, FIGURES[name])


def _draw_runs(
    arguments: argparse.Namespace, folder: Path, name: str, figure: Figure
) -> None:
    runs = figure.runs(
        folder,
        num_seeds=arguments.seeds,
        num_steps=arguments.steps,
        agents=_named(arguments.agents),
    )
    for begun in runs:
        fill(begun, arguments.shard)
    begun = [one.folder for one in runs if len(one.missing()) < one.num_seeds]
    if begun:
        report(
            begun, folder / f"{name}.png", as_json=arguments.json, title=_title(name)
        )


def _draw_samples(arguments: argparse.Namespace, folder: Path) -> None:
    """Figure 1a: of each learner, errors by number of samples, seed by seed."""
    from boomdp_jax.viz.learning_curves import plot_sample_curves

    task = make_task(_TASK)
    place, num = arguments.shard or (0, 1)
    curves: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    # All names are looked at before the first learner takes its minutes.
    asked = []
    for agent in _named(arguments.agents) or _LEARNERS:
        paths = [
            folder / "runs" / f"{_TASK}-samples-{agent}" / f"seed-{seed:05d}.npz"
            for seed in range(arguments.seeds)
        ]
        missing = [
            seed
            for seed in range(place, arguments.seeds, num)
            if not paths[seed].exists()
        ]
        found = sample_errors(agent, task, task.default_params(), missing)
        asked.append((agent, paths, missing, found))
    for agent, paths, missing, found in asked:
        paths[0].parent.mkdir(parents=True, exist_ok=True)
        for count, (seed, errors) in enumerate(zip(missing, found, strict=True)):
            write_npz(paths[seed], errors._asdict())
            print(f"{agent}: {count + 1}/{len(missing)}", file=sys.stderr)
        there = [read_npz(path) for path in paths if path.exists()]
        if there:
            curves[agent] = tuple(  # ty: ignore[invalid-assignment]
                np.stack([one[field] for one in there])
                for field in SampleErrors._fields
            )
    if not curves:
        return
    bands = [
        {
            f"{agent} ({len(errors[0])} seeds)": mean_band(errors[which])
            for agent, errors in curves.items()
        }
        for which in range(2)
    ]
    figure = plot_sample_curves(*bands, SIZES, title=_title("1a"))
    path = folder / "1a.png"
    figure.savefig(path, dpi=150)
    _print_samples(curves, as_json=arguments.json)
    print(path, file=sys.stderr)


def _print_samples(
    curves: dict[str, tuple[np.ndarray, np.ndarray]], *, as_json: bool
) -> None:
    """Means over seeds."""
    fields = SampleErrors._fields
    means = {
        agent: [part.mean(axis=0).tolist() for part in errors]
        for agent, errors in curves.items()
    }
    if as_json:
        for agent, parts in means.items():
            found = dict(zip(fields, parts, strict=True))
            print_json({"agent": agent, "samples": list(SIZES), **found})
        return
    print(f"{'held-out error after':<28}" + "".join(f"{size:>9}" for size in SIZES))
    for agent, parts in means.items():
        for field, unit, errors in zip(fields, ("m", "m/s"), parts, strict=True):
            label = f"{agent}, {field} [{unit}]"
            print(f"{label:<28}" + "".join(f"{error:>9.2g}" for error in errors))


def _named(agents: Sequence[str] | None) -> tuple[str, ...] | None:
    return tuple(agents) if agents else None


def _title(name: str) -> str:
    return f"figure {name}" if name[0].isdigit() else name
