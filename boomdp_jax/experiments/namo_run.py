"""Many rooms of one agent, written room by room, resumable; as `experiments.run`.

A folder holds `run.json`, one `seed-00000.npz` for each room that is done, and, once
all are, `results.npz` with leading axis `seed`: whether the room was solved, simulated
seconds, effort, pushes, wasted pushes, and real seconds of decisions. What happened in
a room comes out to the same bits however often the run was stopped.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from boomdp_jax.agents.namo_episode import NamoRecord, Try
from boomdp_jax.core.json_file import check_same, read_json, write_json
from boomdp_jax.core.npz_file import read_npz, write_npz
from boomdp_jax.core.versions import library_versions
from boomdp_jax.envs.namo_room import KINDS
from boomdp_jax.experiments.namo import CHARACTERS, make_room, namo_episode
from boomdp_jax.experiments.run import SCHEMA
from boomdp_jax.experiments.seed_files import is_done, write_seed

FIELDS = ("is_solved", "seconds", "effort", "num_pushes", "num_wasted")
"""Numbers of one room in `results.npz`, beside `decision_seconds` (the median), and the
greatest force of the grasp and overlap."""


class NamoRun(NamedTuple):
    """One agent in many rooms."""

    folder: Path
    agent: str
    num_seeds: int
    room: str
    """`random` or `story`."""
    num_things: int
    difficulty: float
    delay: int = 0
    """Of readings, in steps."""

    def path(self, seed: int) -> Path:
        """File of one room."""
        return self.folder / f"seed-{seed:05d}.npz"

    def missing(self, shard: tuple[int, int] = (0, 1)) -> list[int]:
        """Rooms of a shard that have no file yet, or one that was damaged."""
        place, num = shard
        seeds = range(place, self.num_seeds, num)
        return [seed for seed in seeds if not is_done(self.path(seed), seed)]

    def run_seeds(
        self,
        seeds: list[int],
        report: Callable[[int, NamoRecord], None] | None = None,
    ) -> None:
        """Do some rooms and write each as it is done.

        Args:
            seeds: which.
            report: called with seed and record of each.
        """
        for seed in seeds:
            room = make_room(self.room, seed, self.num_things, self.difficulty)
            record, _ = namo_episode(self.agent, room, seed, delay=self.delay)
            write_seed(self.path(seed), seed, arrays_of(record))
            if report is not None:
                report(seed, record)

    def collect(self) -> dict[str, np.ndarray] | None:
        """Put all rooms together, if all are there.

        Returns:
            What `results.npz` then holds; None while rooms are missing.
        """
        if self.missing():
            return None
        records = [read_npz(self.path(seed)) for seed in range(self.num_seeds)]
        names = (*FIELDS, "most_force", "most_overlap")
        results = {name: np.stack([one[name] for one in records]) for name in names}
        seconds = [one["decision_seconds"] for one in records]
        results["decision_seconds"] = np.array(
            [np.median(own) if len(own) else np.nan for own in seconds]
        )
        write_npz(self.folder / "results.npz", results)
        return results


def begin_namo(
    agent: str,
    folder: str | os.PathLike,
    *,
    num_seeds: int,
    room: str = "random",
    num_things: int = 4,
    difficulty: float = 0.5,
    delay: int = 0,
) -> NamoRun:
    """Begin a run in a folder, or take up one that was begun there.

    Args:
        agent: one of `CHARACTERS`.
        folder: made if there is none.
        num_seeds: rooms; their seeds are 0, 1, ... A run may be begun again with more
            of them.
        room: `random` or `story`.
        num_things: in a random room.
        difficulty: of a random room.
        delay: of the poses and twists that the robot reads, in steps.

    Returns:
        The run.

    Raises:
        ValueError: an unknown name, a number out of range, or a folder in which
            something else was begun.
        OSError: the folder cannot be written.
    """
    if num_seeds < 1:
        raise ValueError(f"num_seeds: expected at least 1, got {num_seeds}")
    if agent not in CHARACTERS:
        raise ValueError(
            f"agent: expected one of {', '.join(CHARACTERS)} in namo; got {agent!r}"
        )
    if delay < 0:
        raise ValueError(f"delay: expected at least 0 steps, got {delay}")
    # Refuses what is no room.
    num_things = make_room(room, 0, num_things, difficulty).num_things
    run = NamoRun(
        Path(folder), agent, num_seeds, room, num_things, float(difficulty), delay
    )
    run.folder.mkdir(parents=True, exist_ok=True)
    content = {
        "schema": SCHEMA,
        "task": "namo",
        "agent": agent,
        "num_seeds": num_seeds,
        "room": room,
        "num_things": num_things,
        "difficulty": float(difficulty),
        "delay": delay,
        "versions": library_versions(),
    }
    path = run.folder / "run.json"
    if path.exists():
        # Runs of older versions do not name a delay; there was none.
        begun = {"delay": 0, **read_json(path, SCHEMA)}
        # Rooms do not depend on how many there are: more of them go on.
        more = {**begun, "num_seeds": max(num_seeds, begun.get("num_seeds", 0))}
        check_same(path, more, content)
        if begun == content:
            return run
    write_json(path, content)
    return run


def arrays_of(record: NamoRecord) -> dict[str, np.ndarray]:
    """A record as arrays.

    Args:
        record: of one room.

    Returns:
        Its numbers; of tries, leading axis `try`, the last shares of kinds being what
        was believed in the end.
    """
    numbers = {
        name: np.asarray(getattr(record, name))
        for name in (*FIELDS, "poses", "decision_seconds", "most_force", "most_overlap")
    }
    tries = record.tries
    for name in Try._fields[:-1]:
        numbers[f"try_{name}"] = np.array([getattr(one, name) for one in tries])
    last = [[one.shares[-1][kind] for kind in KINDS] for one in tries]
    numbers["try_shares"] = np.array(last).reshape(len(tries), len(KINDS))
    return numbers
