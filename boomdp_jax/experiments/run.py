"""Many episodes of one agent on one task: written seed by seed, resumable.

A folder holds `run.json` (what was begun: task, agent, steps, seeds, noise, versions),
one `seed-00000.npz` for each episode that is done, written whole or not at all, and,
once all are, `results.npz` with leading axis `seed`. Whoever begins the same run in the
same folder goes on where it stands; rewards, actions and states come out to the same
bits however often it was stopped and however many machines shared it. Begun again with
more seeds, it goes on to those.
"""

import functools
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, PyTree

from boomdp_jax.agents.agent import Agent
from boomdp_jax.agents.compiled_episode import can_compile, compile_episode
from boomdp_jax.agents.episode import EpisodeRecord, run_episode
from boomdp_jax.core.arrays import Key, on_device
from boomdp_jax.core.json_file import check_same, read_json, write_json
from boomdp_jax.core.npz_file import read_npz, write_npz
from boomdp_jax.core.versions import library_versions
from boomdp_jax.envs.environment import AbstractEnvironment, EnvParams
from boomdp_jax.experiments.registry import agent_of, check_agent, make_task
from boomdp_jax.experiments.seed_files import is_done, write_seed

SCHEMA = "boomdp-run-1"
"""Version of the folder's format."""

MAKING = "making_seconds"
"""Beside an episode's record: the time it took to make the agent, all that it was
taught beforehand included; the same for all episodes of one process."""


class Run(NamedTuple):
    """One agent on one task, over seeds."""

    folder: Path
    task: str
    agent: str
    num_seeds: int
    num_steps: int
    noise: tuple[float, float, float, float] | None
    """Standard deviation of the readings that are learnt from."""
    world: str | None = None
    """What is true instead of what agents are told; None: nothing."""

    def path(self, seed: int) -> Path:
        """File of one episode."""
        return self.folder / f"seed-{seed:05d}.npz"

    def missing(self, shard: tuple[int, int] = (0, 1)) -> list[int]:
        """Seeds of a shard that have not been run yet.

        Args:
            shard: place i and number n of shards; a shard has seeds i, i + n and so on.

        Returns:
            Those without a file, or with one that was damaged.

        Raises:
            ValueError: no such shard, or a file that is not of this run.
        """
        place, num = shard
        if not 0 <= place < num:
            raise ValueError(f"shard: expected 0 <= place < number, got {place}/{num}")
        seeds = range(place, self.num_seeds, num)
        length = self.num_steps
        return [s for s in seeds if not is_done(self.path(s), s, num_steps=length)]

    def run_seeds(
        self,
        seeds: Sequence[int],
        report: Callable[[int, EpisodeRecord], None] | None = None,
    ) -> None:
        """Run some episodes and write each as it is done.

        Args:
            seeds: which.
            report: called with seed and record of each.
        """
        task = make_task(self.task, self.num_steps, self.world)
        params = task.default_params()
        noise = None if self.noise is None else on_device(self.noise)
        begin = time.perf_counter()
        agent = agent_of(self.agent, task, params, reading_noise=noise)
        made = {MAKING: np.asarray(time.perf_counter() - begin)}
        if can_compile(agent) and seeds:
            episode = compile_episode(task, params, agent, reading_noise=noise)
        else:
            episode = functools.partial(
                _looped, task=task, params=params, agent=agent, noise=noise
            )
        for seed in seeds:
            record, _ = episode(jax.random.key(seed))
            write_seed(self.path(seed), seed, record._asdict() | made)
            if report is not None:
                report(seed, record)

    def collect(self) -> dict[str, np.ndarray] | None:
        """Put all episodes together, if all are there.

        Returns:
            What `results.npz` then holds: the fields of `EpisodeRecord` with a leading
            axis `seed`, and `making_seconds`; None while episodes are missing.
        """
        if self.missing():
            return None
        records = [read_npz(self.path(seed)) for seed in range(self.num_seeds)]
        results = {
            field: np.stack([record[field] for record in records])
            for field in (*EpisodeRecord._fields, MAKING)
        }
        write_npz(self.folder / "results.npz", results)
        return results


def _looped(
    key: Key,
    *,
    task: AbstractEnvironment,
    params: EnvParams,
    agent: Agent,
    noise: Float[Array, "4"] | None,
) -> tuple[EpisodeRecord, PyTree]:
    """An episode step by step, of a model that learns on the host."""
    return run_episode(key, task, params, agent, reading_noise=noise)


def begin_run(
    task: str,
    agent: str,
    folder: str | os.PathLike,
    *,
    num_seeds: int,
    num_steps: int | None = None,
    noise: Sequence[float] | None = None,
    world: str | None = None,
) -> Run:
    """Begin a run in a folder, or take up one that was begun there.

    Args:
        task: name of a task.
        agent: name of an agent.
        folder: made if there is none.
        num_seeds: episodes; their seeds are 0, 1, ... A run may be begun again with
            more of them.
        num_steps: of each; default: the task's own.
        noise: standard deviation of the readings that agents learn from: position [m],
            angle [rad], velocity [m/s], spin [rad/s]; none: exact.
        world: of the cart, what is true instead of what agents are told; default: the
            task as it is.

    Returns:
        The run.

    Raises:
        ValueError: an unknown name, a number out of range, or a folder in which
            something else was begun; the message names the entry.
        OSError: the folder cannot be written.
    """
    if num_seeds < 1:
        raise ValueError(f"num_seeds: expected at least 1, got {num_seeds}")
    made = make_task(task, num_steps, world)
    check_agent(agent, made)
    scale = None
    if noise is not None:
        scale = tuple(float(number) for number in noise)
        if len(scale) != 4 or not all(np.isfinite(s) and s >= 0 for s in scale):
            raise ValueError(
                "noise: expected four finite numbers of at least 0 (position, angle, "
                f"velocity, spin), got {list(noise)}"
            )
    run = Run(Path(folder), task, agent, num_seeds, made.num_steps, scale, world)
    run.folder.mkdir(parents=True, exist_ok=True)
    content = {
        "schema": SCHEMA,
        "task": task,
        "agent": agent,
        "num_seeds": num_seeds,
        "num_steps": made.num_steps,
        "noise": None if scale is None else list(scale),
        "versions": library_versions(),
    }
    if world is not None:
        content["world"] = world
    path = run.folder / "run.json"
    if path.exists():
        begun = read_json(path, SCHEMA)
        # Episodes do not depend on how many there are: more of them go on.
        more = {**begun, "num_seeds": max(num_seeds, begun.get("num_seeds", 0))}
        check_same(path, more, content)
        if begun == content:
            return run
    write_json(path, content)
    return run
