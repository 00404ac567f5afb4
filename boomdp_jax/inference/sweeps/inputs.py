"""What goes into a unit of a sweep: lengths of histories, and hashes of everything."""

import hashlib
import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np

from boomdp_jax.core.history import History
from boomdp_jax.core.history_file import load_history
from boomdp_jax.inference.sweeps.arguments import Recording
from boomdp_jax.physics.scene_spec import SceneSpec

# Fewest rows that a history is padded to.
_LEAST_ROWS = 4


def read_recording(spec: SceneSpec, source: Recording, num_rows: int | None) -> History:
    """A recording of an object, read if it is a file.

    Args:
        spec: its scene.
        source: of the object.
        num_rows: how many rows of a file to use; None: all.

    Returns:
        Its history.

    Raises:
        ValueError: a file that does not fit the scene.
        OSError: a file that cannot be read.
    """
    if isinstance(source, History):
        return source
    with warnings.catch_warnings():
        # What there is to warn of was said when the sweep began.
        warnings.simplefilter("ignore")
        return load_history(source, spec=spec, num_rows=num_rows)


def with_room(histories: Sequence[History]) -> list[History]:
    """Histories of which the longest has one of few lengths; see `roomy`."""
    out = list(histories)
    capacities = [history.capacity for history in out]
    longest = int(np.argmax(capacities))
    out[longest] = out[longest].padded(roomy(max(capacities)))
    return out


def roomy(num_rows: int) -> int:
    """The next of 4, 6, 8, 12, 16, 24...: few lengths, so that few are compiled for."""
    power = _LEAST_ROWS
    while 2 * power <= num_rows:
        power *= 2
    return next(n for n in (power, power * 3 // 2, 2 * power) if n >= num_rows)


def named(refused: Mapping[int, str], histories: Sequence[Recording]) -> dict[str, str]:
    """Messages about objects with what users know each by, by number as text.

    Args:
        refused: messages by number.
        histories: recordings of all objects.
    """
    out = {}
    for number, message in refused.items():
        source = histories[number]
        name = f"object {number}" if isinstance(source, History) else str(source)
        out[str(number)] = f"{name}: {message}"
    return out


def other_input(path: Path, number: int, source: Recording) -> ValueError:
    """What is said where a unit was made from something else.

    Args:
        path: the record of the unit.
        number: of the object.
        source: its recording now.
    """
    name = "" if isinstance(source, History) else f" ({source})"
    return ValueError(
        f"{path}: inputs: object {number}{name}: expected the recording and scene that "
        "the folder was begun with, got others; choose another folder"
    )


def hash_of_scenes(specs: Sequence[SceneSpec]) -> str:
    """Of scenes in order."""
    # Mostly one and the same for thousands of recordings.
    each = {id(spec): spec for spec in specs}
    scenes = {name: scene_bytes(spec) for name, spec in each.items()}
    return hash_of(*(scenes[id(spec)] for spec in specs))


def scene_bytes(spec: SceneSpec) -> bytes:
    """A scene as bytes, the same ones for equal scenes."""
    return json.dumps(spec.to_dict(), sort_keys=True).encode()


def hash_of(*parts: bytes) -> str:
    """Of several strings of bytes, one after the other, each with its length."""
    found = hashlib.sha256()
    for part in parts:
        found.update(len(part).to_bytes(8, "big"))
        found.update(part)
    return found.hexdigest()


def input_hash(spec: SceneSpec, source: Recording) -> str:
    """Of a recording and its scene.

    Raises:
        OSError: a file that cannot be read.
    """
    scene = scene_bytes(spec)
    if not isinstance(source, History):
        return hash_of(scene, Path(source).read_bytes())
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(source)]
    parts = [(f"{x.dtype}{x.shape}".encode(), x.tobytes()) for x in leaves]
    return hash_of(scene, *(part for pair in parts for part in pair))
