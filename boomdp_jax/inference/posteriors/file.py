"""The file of a posterior: arrays by name and a JSON header, read without trust."""

import dataclasses
import json
import os
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.json_header import read_json_header
from boomdp_jax.core.npz_file import read_npz, write_npz
from boomdp_jax.inference.hypotheses.body_numbers import get_number, with_numbers
from boomdp_jax.inference.hypotheses.layout import BODY_NUMBERS
from boomdp_jax.physics.params import (
    Distance,
    Ground,
    Params,
    Prismatic,
    Revolute,
    Surface,
    Weld,
    Wheel,
)

SCHEMA = "boomdp-posterior-1"
MAX_HEADER_BYTES = 2**24
"""Most bytes of the JSON header (16 MiB): a scene of some ten thousand bodies."""

_GROUPS = {
    "revolute": Revolute,
    "distance": Distance,
    "prismatic": Prismatic,
    "weld": Weld,
    "wheel": Wheel,
    "ground": Ground,
    "surface": Surface,
}
_OPTIONAL = ("prismatic", "weld")
"""Groups that a file may do without: scenes may, and those of earlier versions did."""

_BODY_NUMBERS = {
    name: ("body", count) if count > 1 else ("body",)
    for name, count in BODY_NUMBERS.items()
}
"""Numbers of bodies that are there where they are inferred."""

_KINDS = {"active": "b", "body_a": "i", "body_b": "i", "chain": "i"}
"""Kind of an array by the last part of its name; all others hold floats."""

_HEADER_FIELDS = {
    "scene": dict,
    "diagnostics": dict,
    "seconds": dict,
    "seed": (int, type(None)),
    "versions": dict,
}
# Axes by name; a name stands for the same length wherever it occurs.
_SHAPES = {
    "noise_scale": ("draw", "body", 4),
    "log_weight": ("draw",),
    "log_density": ("draw",),
    "chain": ("draw",),
    "prior_noise_scale": ("prior draw", "body", 4),
    "impulse_scale": ("draw", "body", 2),
    "prior_impulse_scale": ("prior draw", "body", 2),
    "log_evidence": (),
    "inferred.revolute": ("revolute slot",),
    "inferred.distance": ("distance slot",),
    "inferred.prismatic": ("prismatic slot",),
    "inferred.weld": ("weld slot",),
    "inferred.wheel": ("body", "wheel slot"),
    "inferred.ground": ("body", "ground slot"),
}
_PARAM_SHAPES = {
    "density": ("body",),
    "revolute": ("revolute slot",),
    "distance": ("distance slot",),
    "prismatic": ("prismatic slot",),
    "weld": ("weld slot",),
    "wheel": ("body", "wheel slot"),
    "ground": ("body", "ground slot"),
    "surface": ("body",),
}
_IMPULSES = ("impulse_scale", "prior_impulse_scale")
"""Both are there, or neither."""
_PAIRS = {
    "revolute": ("anchor_a", "anchor_b", "limit", "motor"),
    "distance": ("anchor_a", "anchor_b"),
    "prismatic": ("anchor_a", "anchor_b", "limit", "motor"),
    "weld": ("anchor_a", "anchor_b"),
    "wheel": ("position", "viscous", "dry"),
    "ground": ("load_shift", "stance_scale"),
    "surface": (),
}
"""Fields with two numbers in each slot."""


def write_posterior_file(
    path: str | os.PathLike,
    arrays: Mapping[str, np.ndarray],
    params: Params,
    prior_params: Params,
    header: dict,
) -> None:
    """Write a posterior, the whole file or nothing.

    Args:
        path: the file.
        arrays: all but the params, by name.
        params: draws of Φ.
        prior_params: prior draws of Φ.
        header: what JSON can hold.
    """
    text = json.dumps({"schema": SCHEMA, **header}, allow_nan=False)
    content = {
        "header": np.frombuffer(text.encode(), np.uint8),
        **arrays,
        **_flatten("params", params),
        **_flatten("prior_params", prior_params),
    }
    write_npz(path, content)


def read_posterior_file(
    path: str | os.PathLike,
) -> tuple[dict[str, np.ndarray], Params, Params, dict]:
    """Read a posterior and check schema, kinds and shapes.

    Args:
        path: the file.

    Returns:
        Arrays by name, draws of Φ, prior draws of Φ, and the header.

    Raises:
        ValueError: one line, naming the file and the field.
        OSError: the file cannot be opened.
    """
    arrays = read_npz(path)
    header = read_json_header(
        path,
        arrays.pop("header", None),
        what="a posterior",
        schema=SCHEMA,
        fields=_HEADER_FIELDS,
        max_bytes=MAX_HEADER_BYTES,
    )
    expected = _expected_shapes(arrays)
    _check_arrays(path, arrays, expected)
    params = _unflatten("params", arrays)
    prior_params = _unflatten("prior_params", arrays)
    return arrays, params, prior_params, header


def _flatten(prefix: str, params: Params) -> dict[str, np.ndarray]:
    """Arrays of params by dotted name; nuisances that are None are left out."""
    arrays = {f"{prefix}.density": np.asarray(params.density)}
    for name in _BODY_NUMBERS:
        value = get_number(params, name)
        if value is not None:
            arrays[f"{prefix}.{name}"] = np.asarray(value)
    for group in _GROUPS:
        module = getattr(params, group)
        if module is None:
            continue
        for field in dataclasses.fields(module):
            value = getattr(module, field.name)
            if value is not None:
                arrays[f"{prefix}.{group}.{field.name}"] = np.asarray(value)
    return arrays


def _unflatten(prefix: str, arrays: Mapping[str, np.ndarray]) -> Params:
    """Build params from arrays by dotted name."""
    groups: dict[str, Any] = {}
    for group, module in _GROUPS.items():
        if not _has(group, arrays):
            continue
        numbers: dict[str, Any] = dict.fromkeys(
            field.name for field in dataclasses.fields(module)
        )
        for name in numbers:
            array = arrays.get(f"{prefix}.{group}.{name}")
            numbers[name] = None if array is None else jnp.asarray(array)
        groups[group] = module(**numbers)
    params = Params(density=jnp.asarray(arrays[f"{prefix}.density"]), **groups)
    numbers = {
        name: jnp.asarray(arrays[f"{prefix}.{name}"])
        for name in _BODY_NUMBERS
        if f"{prefix}.{name}" in arrays
    }
    return with_numbers(params, numbers)


def _has(group: str, arrays: Mapping[str, np.ndarray]) -> bool:
    """Whether a file has a group, or must have it."""
    if group == "surface":
        return any(name.startswith("params.surface.") for name in arrays)
    return group not in _OPTIONAL or f"inferred.{group}" in arrays


def _expected_shapes(arrays: Mapping[str, np.ndarray]) -> dict[str, tuple]:
    """Axes of every array that must be there, and of nuisances that are there."""
    shapes: dict[str, tuple] = {
        name: axes
        for name, axes in _SHAPES.items()
        if _has(name.removeprefix("inferred."), arrays)
        and (name not in _IMPULSES or any(other in arrays for other in _IMPULSES))
    }
    for prefix, draw in (("params", "draw"), ("prior_params", "prior draw")):
        shapes[f"{prefix}.density"] = (draw, *_PARAM_SHAPES["density"])
        for name, axes in _BODY_NUMBERS.items():
            if any(f"{each}.{name}" in arrays for each in ("params", "prior_params")):
                shapes[f"{prefix}.{name}"] = (draw, *axes)
        for group, module in _GROUPS.items():
            if not _has(group, arrays):
                continue
            for field in dataclasses.fields(module):
                name = f"{prefix}.{group}.{field.name}"
                is_optional = field.default is None
                if is_optional and name not in arrays:
                    continue
                pair = (2,) if field.name in _PAIRS[group] else ()
                shapes[name] = (draw, *_PARAM_SHAPES[group], *pair)
    return shapes


def _check_arrays(
    path: str | os.PathLike,
    arrays: Mapping[str, np.ndarray],
    expected: Mapping[str, tuple],
) -> None:
    """Compare names, kinds and shapes; an axis has one length in the whole file."""
    if arrays.keys() != expected.keys():
        odd = sorted(arrays.keys() ^ expected.keys())[0]
        what = "is missing" if odd in expected else "is not known"
        raise ValueError(f"{path}: {odd}: the array {what}")
    lengths: dict[str, int] = {}
    for name, axes in expected.items():
        array = arrays[name]
        kind = (
            "b"
            if name.startswith("inferred.")
            else _KINDS.get(name.split(".")[-1], "f")
        )
        if array.dtype.kind != kind:
            raise ValueError(
                f"{path}: {name}: expected kind {kind!r}, got {array.dtype}"
            )
        wanted = tuple(
            axis if isinstance(axis, int) else lengths.setdefault(axis, size)
            for axis, size in zip(axes, array.shape, strict=False)
        )
        if array.ndim != len(axes) or array.shape != wanted:
            raise ValueError(
                f"{path}: {name}: expected shape {list(axes)} with {lengths}, got "
                f"{array.shape}"
            )
    if lengths["draw"] < 1 or lengths["prior draw"] < 1:
        raise ValueError(f"{path}: expected at least one draw of each kind, got none")
