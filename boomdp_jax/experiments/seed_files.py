"""Files of the episodes of a run: which are whole, and whose they are."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from boomdp_jax.core.npz_file import read_npz, write_npz

_SEED = "seed"


def write_seed(path: Path, seed: int, record: Mapping[str, Any]) -> None:
    """Write what an episode came to, whole or not at all.

    Args:
        path: of its file.
        seed: of the episode; the file says so, too.
        record: arrays by name.
    """
    write_npz(path, {**record, _SEED: np.asarray(seed)})


def is_done(path: Path, seed: int, *, num_steps: int | None = None) -> bool:
    """Whether an episode need not be run any more.

    Args:
        path: of its file.
        seed: of the episode.
        num_steps: length of its `reward`; None: not asked.

    Returns:
        False where there is no file, or one that was damaged or cut short since it was
        written.

    Raises:
        ValueError: a file of another episode, or of another number of steps.
        OSError: it cannot be read.
    """
    if not path.exists():
        return False
    try:
        record = read_npz(path)
    except ValueError:
        return False
    # Files of older versions do not name a seed.
    found = int(record.get(_SEED, seed))
    if found != seed:
        raise ValueError(
            f"{path}: {_SEED}: expected {seed}, as its name has it, got {found}; "
            "remove it, and the episode is run again"
        )
    length = None if num_steps is None else len(record.get("reward", ()))
    if length != num_steps:
        raise ValueError(
            f"{path}: reward: expected {num_steps} steps, got {length}; remove it, and "
            "the episode is run again"
        )
    return True
