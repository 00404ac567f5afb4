"""What `unit-*.json` of a sweep says: what a unit was made from, and what it made."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from boomdp_jax.core.json_file import read_json, write_json
from boomdp_jax.inference.sweeps.inputs import hash_of

UNIT_SCHEMA = "boomdp-sweep-unit-1"


class UnitRecord(NamedTuple):
    """Written when all files of a unit are there."""

    inputs: list[str]
    """Hash of each object's recording and scene, in order."""
    files: dict[str, str]
    """Hash of each posterior, by the name of its file."""
    failed: dict[str, str]
    """Why inference refused an object, by its number."""

    @classmethod
    def read(cls, path: str | os.PathLike) -> "UnitRecord | None":
        """Of a file; None: there is none, or it is not whole."""
        if not os.path.exists(path):
            return None
        try:
            found = {"failed": {}} | read_json(path, UNIT_SCHEMA)
        except ValueError:
            return None
        inputs, files, failed = (found.get(name) for name in cls._fields)
        if not isinstance(inputs, list) or not isinstance(files, dict):
            return None
        return cls(inputs, files, failed) if isinstance(failed, dict) else None

    def write(self, path: str | os.PathLike, unit: int) -> None:
        """Write the record of a unit, the whole file or nothing."""
        content = self._asdict()
        if not self.failed:
            del content["failed"]
        write_json(path, {"schema": UNIT_SCHEMA, "unit": unit, **content})

    def is_whole(self, paths: Mapping[int, Path]) -> bool:
        """Whether the posteriors of a unit are there, but for objects that failed.

        Args:
            paths: where each object's would be, by its number.
        """
        if len(self.inputs) != len(paths):
            return False
        for number, path in paths.items():
            known = self.files.get(path.name)
            if str(number) in self.failed:
                continue
            if not path.exists() or known != hash_of(path.read_bytes()):
                return False
        return True

    def changes(self, inputs: Mapping[int, str]) -> tuple[list[int], bool]:
        """What has changed since a unit was done.

        Args:
            inputs: hash of each object's recording and scene now, by its number.

        Returns:
            Objects with a posterior of other inputs, and whether one that inference
            refused has others now, which may be better ones.
        """
        known = zip(inputs.items(), self.inputs, strict=True)
        changed = [number for (number, now), then in known if now != then]
        others = [number for number in changed if str(number) not in self.failed]
        return others, len(others) < len(changed)

    def failures(self, numbers: Sequence[int]) -> dict[int, str]:
        """Why inference refused objects of a unit, by number, in order."""
        return {n: self.failed[str(n)] for n in numbers if str(n) in self.failed}
