"""Many inferences in units that are done one by one, anywhere, and resumed when killed.

A unit is so many consecutive objects: one call of `infer_batch` with a key of its own.
Which objects are in it does not depend on who does it or when, so neither do its bits.
Shards of a sweep, on several machines or after a kill, write into the same folder:

- `sweep.json`, what the folder was begun with; others are refused.
- `object-000012.npz`, the posterior of each object, as `Posterior.save` writes it.
- `unit-000003.json`, written when all files of a unit are there, with the hashes of
  what went into them and of themselves: what does not match is done again. Objects
  that inference refuses have no file: `failed` says why, by number of the object. They
  count as done, whoever resumes, since the others were inferred without them.
"""

import dataclasses
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from boomdp_jax.core.arrays import Key, on_device
from boomdp_jax.core.checked_input import whole_number
from boomdp_jax.core.json_file import check_same, read_json, write_json
from boomdp_jax.core.versions import library_versions
from boomdp_jax.inference.arguments import check_key
from boomdp_jax.inference.blocks.fixed_structure import Structure
from boomdp_jax.inference.failures import all_but_refused, all_done
from boomdp_jax.inference.infer import checked_options, infer_batch, seed_of
from boomdp_jax.inference.sweeps.arguments import (
    Recording,
    check_recordings,
    check_scenes,
    checked_num_rows,
    checked_shard,
    listed,
    structure_for_file,
)
from boomdp_jax.inference.sweeps.inputs import (
    hash_of,
    hash_of_scenes,
    input_hash,
    named,
    other_input,
    read_recording,
    with_room,
)
from boomdp_jax.inference.sweeps.record import UnitRecord
from boomdp_jax.physics.scene_spec import SceneSpec

SCHEMA = "boomdp-sweep-1"

_MANIFEST = "sweep.json"


def infer_sweep(
    key: Key,
    specs: SceneSpec | Sequence[SceneSpec],
    histories: Recording | Sequence[Recording],
    out_dir: str | os.PathLike,
    *,
    shard: tuple[int, int] = (0, 1),
    batch: int = 16,
    resume: bool = True,
    num_rows: int | None = None,
    progress: bool = False,
    **options: Any,
) -> list[Path]:
    """Infer many objects, unit after unit, and write each posterior to a file.

    What is there already is not done again. A run that was killed at any moment, and
    shards of other processes, end in the same arrays as one run of everything.

    Scenes and files of this shard are looked at before anything is inferred. What only
    inference finds wrong with an object is recorded in the folder: all others are
    done, then it is raised. It is not tried again when the sweep is resumed, which
    raises the same.

    Args:
        key: random key; the key of a unit is folded in from its number.
        specs: one scene for all, or one for each history.
        histories: recordings, or files of the form `planar-transitions-1`, which are
            read again when their unit's turn comes; a single one is a list of one.
        out_dir: folder to write to; made if its parent is there.
        shard: (i, n): do units i, i + n, i + 2 n and so on.
        batch: objects of one unit, inferred in one compiled call.
        resume: whether units of this shard may be there already.
        num_rows: how many rows of each file to use, from the first; default: all. Not
            for recordings in memory.
        progress: show stages on standard error.
        **options: `method`, `structure`, `likelihood`, `horizon`, `outliers`,
            `num_chains`, `num_warmup` and `num_samples`, as `infer_batch` takes them.

    Returns:
        The files of this shard's objects, in order.

    Raises:
        TypeError: a key, scenes or recordings that are none.
        ValueError: a folder that was begun with something else, a shard that does not
            exist, files that do not fit their scenes, all of them named, or options as
            in `infer_batch`.
        SweepError: when all else is done: objects that inference refused. It is a
            ValueError with a line for each, `failed`, and the files of all others,
            `paths`.
        OSError: a file cannot be read or written.
    """
    sweep = begin_sweep(
        key,
        specs,
        histories,
        out_dir,
        shard=shard,
        batch=batch,
        num_rows=num_rows,
        **options,
    )
    units = sweep.units(shard)
    if not resume:
        sweep.check_untouched(units)
    # Other recordings than the folder's are refused before the work, too.
    for unit in [unit for unit in units if not sweep.is_done(unit)]:
        sweep.run(unit, progress=progress)
    return sweep.finish(units)


def begin_sweep(
    key: Key,
    specs: SceneSpec | Sequence[SceneSpec],
    histories: Recording | Sequence[Recording],
    out_dir: str | os.PathLike,
    *,
    shard: tuple[int, int] = (0, 1),
    batch: int = 16,
    num_rows: int | None = None,
    method: str = "auto",
    structure: Structure | None = None,
    likelihood: str = "auto",
    horizon: int | None = None,
    outliers: str = "none",
    num_chains: int = 4,
    num_warmup: int = 200,
    num_samples: int = 500,
    needs_rows: bool = False,
) -> "Sweep":
    """Make or reopen the folder of a sweep, whose units can then be run one by one.

    Arguments are checked first: a folder that was begun with a mistake would refuse
    what was meant.

    Args:
        key: as in `infer_sweep`, as are all others.
        specs: one scene for all, or one for each history.
        histories: recordings, or files, or a single one.
        out_dir: folder to write to.
        shard: the files of its recordings must be there; default: all.
        batch: objects of one unit.
        num_rows: how many rows of each file to use.
        method: as in `infer_batch`.
        structure: as in `infer_batch`.
        likelihood: as in `infer_batch`.
        horizon: as in `infer_batch`.
        outliers: as in `infer_batch`.
        num_chains: as in `infer_batch`.
        num_warmup: as in `infer_batch`.
        num_samples: as in `infer_batch`.
        needs_rows: whether files without rows, whose posterior is the prior, are
            refused.

    Returns:
        The sweep; nothing of it has been run yet.

    Raises:
        TypeError: a key, scenes or recordings that are none.
        ValueError: a folder that was begun with something else, or arguments that make
            no sense, or recordings that do not fit their scenes.
        OSError: a recording cannot be read, or the folder not be made.
    """
    counts, _ = checked_options(
        method=method,
        likelihood=likelihood,
        horizon=horizon,
        outliers=outliers,
        num_chains=num_chains,
        num_warmup=num_warmup,
        num_samples=num_samples,
    )
    check_key(key)
    batch = whole_number("batch", batch, 1)
    specs, histories = listed(specs, histories)
    options = {
        "method": method,
        "structure": structure_for_file(structure),
        "likelihood": likelihood,
        "horizon": None if horizon is None else int(horizon),
        "outliers": outliers,
        "num_chains": counts.num_chains,
        "num_warmup": counts.num_warmup,
        "num_samples": counts.num_samples,
    }
    words = np.asarray(jax.random.key_data(key)).ravel()
    sweep = Sweep(
        folder=Path(out_dir),
        specs=specs,
        histories=histories,
        words=tuple(int(word) for word in words),
        batch=batch,
        num_rows=checked_num_rows(num_rows, histories),
        options=options,
    )
    path = sweep.folder / _MANIFEST
    if path.exists():
        sweep.check_folder()
    check_scenes(specs, method, structure)
    check_recordings(
        specs,
        histories,
        [number for unit in sweep.units(shard) for number in sweep.objects(unit)],
        num_rows=sweep.num_rows,
        needs_rows=needs_rows,
    )
    sweep.folder.mkdir(exist_ok=True)
    if not path.exists():
        write_json(path, sweep.manifest())
    # Another shard may have begun it meanwhile.
    sweep.check_folder()
    return sweep


@dataclasses.dataclass(frozen=True)
class Sweep:
    """A sweep whose folder is there; made by `begin_sweep`."""

    folder: Path
    specs: tuple[SceneSpec, ...]
    histories: tuple[Recording, ...]
    words: tuple[int, ...]
    """Of the random key."""
    batch: int
    num_rows: int | None
    options: dict[str, Any]
    """Of `infer_batch`."""

    @property
    def num_units(self) -> int:
        """How many units there are; the last one may be smaller."""
        return -(-len(self.histories) // self.batch)

    @property
    def key(self) -> Key:
        """The random key."""
        words = on_device(self.words, np.dtype(np.uint32))
        return jax.random.wrap_key_data(words)

    def units(self, shard: tuple[int, int] = (0, 1)) -> range:
        """Numbers of the units of a shard (i, n): i, i + n, i + 2 n and so on."""
        place, num = checked_shard(shard)
        return range(place, self.num_units, num)

    def objects(self, unit: int) -> range:
        """Numbers of the objects of a unit."""
        begin = unit * self.batch
        return range(begin, min(begin + self.batch, len(self.histories)))

    def paths(self, unit: int) -> list[Path]:
        """Files of the posteriors of a unit; failed objects have none."""
        failed = self.failed(unit)
        return [self._path(n) for n in self.objects(unit) if n not in failed]

    def is_done(self, unit: int) -> bool:
        """Whether a unit's files are there, whole; objects that failed count as done.

        Not where one that failed has another recording now: all are done again then.

        Raises:
            ValueError: they are, and were made from other recordings or scenes.
        """
        record = UnitRecord.read(self._record(unit))
        numbers = self.objects(unit)
        paths = {number: self._path(number) for number in numbers}
        if record is None or not record.is_whole(paths):
            return False
        others, is_mended = record.changes({n: self._input_hash(n) for n in numbers})
        for number in others:
            raise other_input(self._record(unit), number, self.histories[number])
        return not is_mended

    def failed(self, unit: int) -> dict[int, str]:
        """Objects of a unit that inference refused: a line for each, by its number."""
        record = UnitRecord.read(self._record(unit))
        return {} if record is None else record.failures(self.objects(unit))

    def finish(self, units: Sequence[int]) -> list[Path]:
        """Files of all objects of units that are done, in order.

        Raises:
            SweepError: inference refused some of the objects; it has the lines that
                say why, and the files of the others.
        """
        failed = {n: line for unit in units for n, line in self.failed(unit).items()}
        paths = [path for unit in units for path in self.paths(unit)]
        return all_done(self.folder, failed, paths)

    def check_folder(self) -> None:
        """Make sure that the folder was begun with this sweep, as this process runs it.

        Raises:
            ValueError: it was not; the line names the first setting that differs.
        """
        path = self.folder / _MANIFEST
        now = json.loads(json.dumps(self.manifest()))
        # Folders of before there was a choice do not name it, nor older ones scenes.
        begun = {"outliers": "none", "scenes": now["scenes"]} | read_json(path, SCHEMA)
        check_same(path, begun, now)

    def check_untouched(self, units: Sequence[int]) -> None:
        """Make sure that none of these units is done.

        Raises:
            ValueError: one is.
        """
        for unit in units:
            if self._record(unit).exists():
                raise ValueError(
                    f"{self.folder}: expected no results of unit {unit} yet, got some; "
                    "resume, or choose another folder"
                )

    def run(self, unit: int, *, progress: bool = False) -> bool:
        """Do a unit, unless it is done.

        An object that inference refuses is recorded, see `failed`, and the others are
        inferred without it.

        Args:
            unit: its number.
            progress: show stages on standard error.

        Returns:
            Whether there was anything to do.
        """
        if self.is_done(unit):
            return False
        # Hashed before it is read: a recording that changes meanwhile is noticed.
        inputs = [self._input_hash(number) for number in self.objects(unit)]
        histories = {
            n: read_recording(self.specs[n], self.histories[n], self.num_rows)
            for n in self.objects(unit)
        }
        posteriors, refused = all_but_refused(
            self.objects(unit),
            lambda numbers: infer_batch(
                jax.random.fold_in(self.key, unit),
                [self.specs[number] for number in numbers],
                with_room([histories[number] for number in numbers]),
                progress=progress,
                **self.options,
            ),
        )
        files = {}
        for number in self.objects(unit):
            path = self._path(number)
            # Left by a run that was killed as it wrote.
            for partial in self.folder.glob(f".{path.name}.*.part"):
                partial.unlink(missing_ok=True)
            if number in refused:
                path.unlink(missing_ok=True)
                continue
            posterior = posteriors[number]
            dataclasses.replace(posterior, seed=seed_of(self.key)).save(path)
            files[path.name] = hash_of(path.read_bytes())
        failed = named(refused, self.histories)
        UnitRecord(inputs, files, failed).write(self._record(unit), unit)
        return True

    def manifest(self) -> dict:
        """All that the bits of the results depend on, but for the recordings."""
        return {
            "schema": SCHEMA,
            "seed": seed_of(self.key),
            "num_objects": len(self.histories),
            "batch": self.batch,
            "num_rows": self.num_rows,
            "scenes": hash_of_scenes(self.specs),
            **self.options,
            "float": str(jax.dtypes.canonicalize_dtype(float)),
            "platform": jax.default_backend(),
            "versions": library_versions(),
        }

    def _record(self, unit: int) -> Path:
        return self.folder / f"unit-{unit:06d}.json"

    def _path(self, number: int) -> Path:
        return self.folder / f"object-{number:06d}.npz"

    def _input_hash(self, number: int) -> str:
        return input_hash(self.specs[number], self.histories[number])
