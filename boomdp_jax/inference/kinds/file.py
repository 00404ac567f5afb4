"""What was learnt of kinds of objects, and its file: a prior for rooms to come."""

import dataclasses
import json
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from boomdp_jax.core.json_header import read_json_header
from boomdp_jax.core.npz_file import read_npz, write_npz
from boomdp_jax.inference.hypotheses.prior import DEFAULT_SCALES
from boomdp_jax.inference.kinds.prior import KindPrior, check_kind_prior
from boomdp_jax.inference.kinds.state import Tallies

SCHEMA = "boomdp-kinds-2"
# Every body of every scene may have a dozen reasons for doubt.
_MAX_HEADER_BYTES = 2**24
_SHAPES = {
    "count": (),
    "structure": ("structure",),
    "label": ("label",),
    "num": ("coordinate",),
    "first": ("coordinate",),
    "second": ("coordinate",),
    "spread": ("coordinate",),
}
"""Axes of each array after `[draw, kind]`."""
_HEADER_FIELDS = {
    "slots": list,
    "labels": list,
    "num_features": int,
    "reach": (int, float),
    "scales": dict,
    "prior": dict,
    "versions": dict,
}


@dataclasses.dataclass(frozen=True, eq=False)
class LearntKinds:
    """Draws of what all objects of each kind add up to; `[draw, kind, ...]`.

    Sums say all there is to know of a kind: its means, spreads and probabilities follow
    from them in closed form. Which number a kind has differs from draw to draw and
    means nothing.
    """

    tallies: Tallies
    spread: np.ndarray
    """Index of the spread of each coordinate."""
    concentration: np.ndarray
    """`[draw]`."""
    slots: tuple[str, ...]
    """Constraints that a body may have, in the order of its slots."""
    labels: tuple[str, ...]
    """Labels by number."""
    num_features: int
    """Features of outlines, the last coordinates; 0: outlines did not count."""
    reach: float
    """How far anchors may lie beyond an outline, in radii."""
    scales: dict[str, tuple[float, float]]
    """Prior of each number of a body, in units of which kinds have theirs."""
    prior: KindPrior
    versions: dict[str, str]
    ok: bool | None = None
    """Whether diagnostics were ok wherever they were learnt, kinds given before
    included; None: not known, as files of older versions do not say."""
    reasons: tuple[str, ...] = ()
    """Why not."""

    @property
    def num_draws(self) -> int:
        """How many draws there are."""
        return len(self.concentration)

    def save(self, path: str | os.PathLike) -> None:
        """Write an NPZ file with a JSON header that `load_kinds` reads.

        Args:
            path: the file; the whole of it or nothing is written.
        """
        header = {
            "schema": SCHEMA,
            "slots": list(self.slots),
            "labels": list(self.labels),
            "num_features": self.num_features,
            "reach": self.reach,
            "scales": self.scales,
            "prior": self.prior._asdict(),
            "versions": dict(self.versions),
            "diagnostics": {"ok": self.ok, "reasons": list(self.reasons)},
        }
        text = json.dumps(header, allow_nan=False)
        arrays = {"header": np.frombuffer(text.encode(), np.uint8)}
        arrays |= self.tallies._asdict()
        arrays |= {"spread": self.spread, "concentration": self.concentration}
        write_npz(path, arrays)


def load_kinds(path: str | os.PathLike) -> LearntKinds:
    """Read what `LearntKinds.save` wrote.

    Args:
        path: the file.

    Returns:
        The kinds, the same to the bit.

    Raises:
        ValueError: not such a file, a damaged one, another schema, or shapes that do
            not fit together; one line.
        OSError: the file cannot be opened.
    """
    arrays = read_npz(path)
    header = read_json_header(
        path,
        arrays.pop("header", None),
        what="kinds",
        schema=SCHEMA,
        fields=_HEADER_FIELDS,
        max_bytes=_MAX_HEADER_BYTES,
    )
    _check_arrays(path, arrays, header)
    try:
        fields: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in header["prior"].items()
        }
        prior = KindPrior(**fields)
        check_kind_prior(prior)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: prior: {error}") from error
    num_spreads = max(len(prior.spreads), len(prior.outline_spreads))
    if arrays["spread"].min() < 0 or arrays["spread"].max() >= num_spreads:
        raise ValueError(f"{path}: spread: expected indices under {num_spreads}")
    ok, reasons = _read_verdict(path, header)
    return LearntKinds(
        tallies=Tallies(**{name: arrays[name] for name in Tallies._fields}),
        spread=arrays["spread"],
        concentration=arrays["concentration"],
        slots=tuple(header["slots"]),
        labels=tuple(header["labels"]),
        num_features=header["num_features"],
        reach=float(header["reach"]),
        scales=_read_scales(path, header["scales"]),
        prior=prior,
        versions=header["versions"],
        ok=ok,
        reasons=reasons,
    )


def _read_verdict(
    path: str | os.PathLike, header: dict
) -> tuple[bool | None, tuple[str, ...]]:
    """Whether diagnostics were ok and why not; older files have none."""
    found = header.get("diagnostics", {"ok": None, "reasons": []})
    ok, reasons = None, None
    if isinstance(found, dict):
        ok, reasons = found.get("ok"), found.get("reasons")
    if not isinstance(ok, bool | None) or not (
        isinstance(reasons, list) and all(isinstance(each, str) for each in reasons)
    ):
        raise ValueError(
            f"{path}: diagnostics: expected ok and a list of reasons, got "
            f"{str(found)[:80]!r}"
        )
    return ok, tuple(reasons)


def _read_scales(path: str | os.PathLike, scales: dict) -> dict:
    """Centre and spread of each number that a prior has."""
    for name in DEFAULT_SCALES:
        pair = scales.get(name)
        is_pair = isinstance(pair, list) and len(pair) == 2
        if not is_pair or not all(isinstance(value, int | float) for value in pair):
            raise ValueError(
                f"{path}: scales: {name}: expected a centre and a spread, got {pair!r}"
            )
    return {name: tuple(map(float, scales[name])) for name in DEFAULT_SCALES}


def _check_arrays(
    path: str | os.PathLike, arrays: Mapping[str, np.ndarray], header: dict
) -> None:
    """Compare names, kinds and shapes; an axis has one length in the whole file."""
    expected: dict[str, tuple[str, ...]] = {
        name: ("draw", "kind", *axes) for name, axes in _SHAPES.items()
    }
    expected["concentration"] = ("draw",)
    if arrays.keys() != expected.keys():
        odd = sorted(arrays.keys() ^ expected.keys())[0]
        what = "is missing" if odd in expected else "is not known"
        raise ValueError(f"{path}: {odd}: the array {what}")
    lengths = {"label": len(header["labels"]) + 1}
    for name, axes in expected.items():
        array = arrays[name]
        kind = "i" if name == "spread" else "f"
        wanted = tuple(
            lengths.setdefault(axis, size)
            for axis, size in zip(axes, array.shape, strict=False)
        )
        if array.dtype.kind != kind or array.ndim != len(axes) or array.shape != wanted:
            raise ValueError(
                f"{path}: {name}: expected shape {list(axes)} with {lengths}, got "
                f"{array.shape} of {array.dtype}"
            )
        if kind == "f" and not np.all(np.isfinite(array)):
            raise ValueError(f"{path}: {name}: expected finite numbers")
    if lengths["draw"] < 1:
        raise ValueError(f"{path}: expected at least one draw, got none")
