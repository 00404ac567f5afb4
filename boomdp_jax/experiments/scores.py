"""What runs come to: mean reward with bands, regret, marks, beside published values."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from boomdp_jax.core.json_file import read_json
from boomdp_jax.core.npz_file import read_npz
from boomdp_jax.experiments.run import SCHEMA

CART_MARKS = (20.0 / 370.0, 5.0 / 370.0, 1.0 / 370.0)
ROOM_MARKS = (20.0 / 63.0, 10.0 / 63.0, 5.0 / 63.0)
"""Shares of the first mean reward, of the published marks -20, -5, -1 of -370 and -20,
-10, -5 of -63."""
MARKS: Mapping[str, tuple[float, ...]] = MappingProxyType(
    {"cart": CART_MARKS, "living-room": ROOM_MARKS}
)
"""By task; others have those of the cart."""

_NUM_RESAMPLES, _COVERAGE = 1000, 0.95
# Of two or three seeds the bootstrap's band is the range of their curves, which holds
# the mean of normal ones in 50 and 75 % of cases; of four that is 79, of five 84, of
# twenty 93 %.
_LEAST_FOR_BAND = 5


class Published(NamedTuple):
    """A curve of Scholz et al. (2014), read off their figures."""

    agent: str
    marks: tuple[int | None, ...]
    """Step from which the mean reward stays within each mark; None: never."""
    regret: float
    """Reward that the true model earned more, as a share of what that one paid."""


PUBLISHED: Mapping[str, tuple[Published, ...]] = MappingProxyType(
    {
        "cart": (
            Published("TRUE", (21, 24, 30), 0.0),
            Published("PBRL", (27, 30, 34), 1076 / 3766),
            Published("OO-LWR", (178, 185, 190), 15535 / 3766),
            Published("LWR", (None, None, None), 64749 / 3766),
        ),
        "cart, noisy": (
            Published("TRUE", (31, 32, None), 0.0),
            Published("PBRL", (500, 876, None), 25861 / 4185),
            Published("OO-LWR", (None, None, None), 115134 / 4185),
            Published("LWR", (None, None, None), 139669 / 4185),
        ),
        "living-room": (
            Published("TRUE", (55, 88, 184), 0.0),
            Published("PBRL, kinds learnt beforehand", (166, 206, 252), 6010 / 3654),
            Published("OO-LWR", (None, None, None), 79567 / 3654),
        ),
    }
)
"""By task. Units, masses and forces were not published, so that steps compare in shape
only; of the noisy cart the third mark was not read off."""


class LoadedRun(NamedTuple):
    """The episodes of a run that are there."""

    folder: Path
    task: str
    agent: str
    is_noisy: bool
    num_asked: int
    """Seeds of the whole run."""
    reward: Float[np.ndarray, "seed step"]
    model_error: Float[np.ndarray, "seed step"]
    """[m]; NaN after the goal was reached."""
    decision: float
    """Median time of a decision [s]."""
    learning: float
    """Median over episodes of the mean time of learning from a step [s]: the first ones
    compile. NaN where `decision` counts it in."""
    world: str | None = None
    """What was true instead of what agents are told."""
    noise: tuple[float, ...] | None = None
    """Standard deviation of readings [m, rad, m/s, rad/s]; None: they are exact."""

    @property
    def setting(self) -> str:
        """The task, its world, and whether readings were noisy."""
        parts = [self.task, *([self.world] if self.world else [])]
        return ", ".join([*parts, "noisy"] if self.is_noisy else parts)


class Score(NamedTuple):
    """One run in numbers."""

    agent: str
    num_seeds: int
    total: float
    """Mean over seeds of the sum of rewards."""
    total_error: float
    """Standard error of it; NaN of a single seed."""
    marks: tuple[int | None, ...]
    regret: float | None
    """To the run of `true`, as a share of what that one paid; None without one."""
    decision: float
    learning: float


def check_is_run(folder: str | os.PathLike) -> None:
    """Refuse a folder that is no run before one of its files is missed.

    Args:
        folder: what `run --out` wrote.

    Raises:
        ValueError: a folder of something else, or none.
    """
    folder = Path(folder)
    if (folder / "run.json").is_file():
        return
    got = "one without run.json"
    if not folder.is_dir():
        got = "a file" if folder.exists() else "none there"
    raise ValueError(
        f"{folder}: is not a run: expected a folder written by `run`, got {got}"
    )


def load_run(folder: str | os.PathLike) -> LoadedRun:
    """Read the episodes of a run, as many as there are.

    Args:
        folder: what `run --out` wrote.

    Raises:
        ValueError: a folder of something else, of a task without rewards, or without an
            episode.
        OSError: it cannot be read.
    """
    folder = Path(folder)
    check_is_run(folder)
    content = read_json(folder / "run.json", SCHEMA)
    if content["task"] == "namo":
        raise ValueError(
            f"{folder}: task: expected one with a reward for each step, got 'namo'; "
            "what came of its rooms is in results.npz, and `view` shows them"
        )
    seeds = [folder / f"seed-{seed:05d}.npz" for seed in range(content["num_seeds"])]
    records = [read_npz(path) for path in seeds if path.exists()]
    if not records:
        raise ValueError(
            f"{folder}: expected at least one episode, seed-00000.npz; got none yet"
        )
    planning = np.concatenate([record["plan_seconds"] for record in records])
    taken = [record["learn_seconds"][record["action"] >= 0] for record in records]
    learning = [np.mean(seconds) for seconds in taken if seconds.size]
    return LoadedRun(
        folder=folder,
        task=content["task"],
        agent=content["agent"],
        is_noisy=bool(content["noise"]) and any(content["noise"]),
        num_asked=content["num_seeds"],
        reward=np.stack([record["reward"] for record in records]),
        model_error=np.stack([record["model_error"] for record in records]),
        decision=float(np.median(planning[planning > 0])),
        learning=float(np.median(learning)) if learning else float("nan"),
        world=content.get("world"),
        noise=tuple(content["noise"]) if any(content.get("noise") or ()) else None,
    )


def check_comparable(runs: Sequence[LoadedRun]) -> None:
    """Refuse to put runs of different tasks, noise or lengths side by side.

    Raises:
        ValueError: two of them differ; the message names both.
    """
    for run in runs[1:]:
        first = runs[0]
        ours = (run.setting, run.reward.shape[1])
        theirs = (first.setting, first.reward.shape[1])
        if ours != theirs:
            raise ValueError(
                f"{run.folder}: expected {theirs[0]} of {theirs[1]} steps as in "
                f"{first.folder}, got {ours[0]} of {ours[1]}"
            )
        if run.noise != first.noise:
            raise ValueError(
                f"{run.folder}: noise: expected {first.noise} as in {first.folder}, "
                f"got {run.noise}"
            )


def mark_step(reward: Float[np.ndarray, " step"], share: float) -> int | None:
    """The first step from which a curve stays within a share of its first value.

    Args:
        reward: mean over seeds, at most 0.
        share: of the first value.

    Returns:
        The step, counted from 1; None if the last one is still outside.
    """
    is_outside = -reward > share * -reward[0]
    if is_outside[-1]:
        return None
    outside = np.flatnonzero(is_outside)
    return int(outside[-1]) + 2 if len(outside) else 1


def mean_band(
    values: Float[np.ndarray, "seed step"],
) -> tuple[
    Float[np.ndarray, " step"], Float[np.ndarray, " step"], Float[np.ndarray, " step"]
]:
    """Mean over seeds, with its 95 % interval by the bootstrap over seeds.

    Args:
        values: of each episode; NaN where it was over, which does not count.

    Returns:
        Mean, and lower and upper end. NaN where no episode has a value; ends also where
        fewer have one than tell how much they scatter, if there were as many at first.
    """
    rng = np.random.default_rng(0)
    num = len(values)
    picked = rng.integers(num, size=(_NUM_RESAMPLES, num))
    is_there = np.isfinite(values)
    filled = np.where(is_there, values, 0.0)
    counts = np.stack([np.bincount(row, minlength=num) for row in picked]).astype(float)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = filled.sum(axis=0) / is_there.sum(axis=0)
        drawn = (counts @ filled) / (counts @ is_there)
    tail = 50 * (1 - _COVERAGE)
    ends = np.full((2, values.shape[1]), np.nan)
    tells = is_there.sum(axis=0) >= min(num, _LEAST_FOR_BAND)
    ends[:, tells] = np.nanpercentile(drawn[:, tells], [tail, 100 - tail], axis=0)
    return mean, ends[0], ends[1]


def band_name(runs: Sequence[LoadedRun]) -> str:
    """What bands of runs by `mean_band` may be called.

    Args:
        runs: of which they are, one or more.
    """
    counts = [len(run.reward) for run in runs]
    if min(counts) >= _LEAST_FOR_BAND:
        return "95 % band"
    if max(counts) < _LEAST_FOR_BAND:
        return "bootstrap range of few seeds"
    return f"95 % band; under {_LEAST_FOR_BAND} seeds bootstrap range"


def scores(runs: Sequence[LoadedRun]) -> list[Score]:
    """Every run in numbers, the best first.

    Args:
        runs: comparable ones, see `check_comparable`.
    """
    known = [run for run in runs if run.agent == "true"]
    paid = -known[0].reward.sum(axis=1).mean() if known else None
    found = []
    for run in runs:
        total = run.reward.sum(axis=1)
        mean = run.reward.mean(axis=0)
        has_error = len(total) > 1
        found.append(
            Score(
                agent=run.agent,
                num_seeds=len(total),
                total=float(total.mean()),
                total_error=float(total.std(ddof=1) / np.sqrt(len(total)))
                if has_error
                else float("nan"),
                marks=tuple(
                    mark_step(mean, share) for share in MARKS.get(run.task, CART_MARKS)
                ),
                regret=None if not paid else float((-total.mean() - paid) / paid),
                decision=run.decision,
                learning=run.learning,
            )
        )
    return sorted(found, key=lambda score: -score.total)
