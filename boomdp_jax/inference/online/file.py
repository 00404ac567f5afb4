"""An online belief in a file: what a robot knows outlives the process that learnt it.

All arrays of the belief, named by their place in it, and a header with all that their
shapes and meaning depend on: scene, sizes and options. A belief goes on in another
process to the bits that it would have come to in this one.
"""

import json
import os
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.json_header import read_json_header
from boomdp_jax.core.npz_file import read_npz, write_npz
from boomdp_jax.core.versions import library_versions
from boomdp_jax.inference.online.fit import RefitSettings
from boomdp_jax.inference.online.state import BeliefState

SCHEMA = "boomdp-belief-1"
_MAX_HEADER_BYTES = 2**24
_KEY = "key"


def settings_for_file(
    settings: RefitSettings, capacity: int, dt: float, blocks: list[tuple[str, ...]]
) -> dict:
    """All that a belief's arrays depend on, as JSON has it.

    Args:
        settings: of its refits.
        capacity: rows of its table.
        dt: length of every step [s], or the usual one where lengths vary.
        blocks: names of the bodies of each block.
    """
    found = {
        "scene": settings.spec.to_dict(),
        "capacity": capacity,
        "num_particles": settings.num_particles,
        "forgetting": settings.forgetting,
        "dt": dt,
        "has_varying_dt": not settings.is_uniform,
        "change_rate": settings.change_rate,
        "num_noise_levels": settings.num_levels,
        "blocks": blocks,
        "float": str(jax.dtypes.canonicalize_dtype(float)),
    }
    return json.loads(json.dumps(found))


def write_belief(
    path: str | os.PathLike, settings: dict[str, Any], belief: BeliefState
) -> None:
    """Write an NPZ file with a JSON header, the whole of it or nothing.

    Args:
        path: the file.
        settings: of `settings_for_file`.
        belief: what to write.
    """
    header = {
        "schema": SCHEMA,
        "settings": settings,
        "key": str(jax.random.key_impl(belief.key)),
        "versions": library_versions(),
    }
    text = json.dumps(header, allow_nan=False)
    arrays = {"header": np.frombuffer(text.encode(), np.uint8)}
    write_npz(path, arrays | _named(belief))


def read_belief(
    path: str | os.PathLike,
    settings: dict[str, Any],
    make_belief: Callable[[str], BeliefState],
) -> BeliefState:
    """Read what `write_belief` wrote.

    Args:
        path: the file.
        settings: of whoever reads it.
        make_belief: makes any belief with these settings, which takes its time; of the
            kind of its random key.

    Returns:
        The belief, the same to the bit.

    Raises:
        ValueError: not such a file, a damaged one, another schema, or a belief with
            other settings, the first of which is named; one line.
        OSError: the file cannot be opened.
    """
    arrays = read_npz(path)
    header = read_json_header(
        path,
        arrays.pop("header", None),
        what="an online belief",
        schema=SCHEMA,
        fields={"settings": dict, "key": str, "versions": dict},
        max_bytes=_MAX_HEADER_BYTES,
    )
    _check_settings(path, header["settings"], settings)
    try:
        like = make_belief(header["key"])
    except ValueError as error:
        raise ValueError(f"{path}: key: {error}") from error
    expected = _named(like)
    if arrays.keys() != expected.keys():
        name = min(arrays.keys() ^ expected.keys())
        is_there = "no such array" if name in arrays else "an array"
        got = "one" if name in arrays else "none"
        raise ValueError(f"{path}: {name}: expected {is_there}, got {got}")
    for name, array in arrays.items():
        asked = expected[name]
        if array.shape != asked.shape or array.dtype != asked.dtype:
            raise ValueError(
                f"{path}: {name}: expected {asked.dtype}{list(asked.shape)}, got "
                f"{array.dtype}{list(array.shape)}"
            )
    places, tree = jax.tree_util.tree_flatten_with_path(like)
    leaves = []
    for place, _ in places:
        array = arrays[_name(place)]
        leaf = on_device(array, array.dtype)
        is_key = _name(place) == _KEY
        kind = header["key"]
        leaves.append(jax.random.wrap_key_data(leaf, impl=kind) if is_key else leaf)
    return jax.tree.unflatten(tree, leaves)


def _check_settings(path: str | os.PathLike, begun: dict, now: dict) -> None:
    """Refuse a belief with other settings, naming the first of them."""
    for name in sorted(begun.keys() | now.keys()):
        if begun.get(name) != now.get(name):
            old, new = (json.dumps(each.get(name)) for each in (begun, now))
            raise ValueError(
                f"{path}: {name}: expected {new}, as this OnlineBelief has it, got "
                f"{old}"
            )


def _named(belief: BeliefState) -> dict[str, np.ndarray]:
    """Arrays by their place; the random key as its words."""
    found = {}
    for place, leaf in jax.tree_util.tree_flatten_with_path(belief)[0]:
        name = _name(place)
        words = jax.random.key_data(leaf) if name == _KEY else leaf
        found[name] = np.asarray(words)
    return found


def _name(place: tuple) -> str:
    """As `blocks.0.particles.z`."""
    return jax.tree_util.keystr(place, simple=True, separator=".")
