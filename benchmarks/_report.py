"""What a benchmark prints: JSON lines for machines, a table for people."""

import argparse
import json
import math
import os
import pathlib
import sys

import jax

from boomdp_jax.core.versions import library_versions

_VERSIONS = ("boomdp_jax", "jax", "jaxlib", "numpyro", "numpy", "mujoco")
_COLUMNS = ("case", "metric", "value", "unit", "n", "peer_value", "target", "met")


def parser_of(text: str, quick: str = "under a minute") -> argparse.ArgumentParser:
    """What all benchmarks understand on their command line.

    Args:
        text: docstring of the benchmark; its first line is shown.
        quick: what is left of it with `--quick`.

    Returns:
        A parser that knows `--quick` and `--out`.
    """
    parser = argparse.ArgumentParser(description=text.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help=quick)
    parser.add_argument(
        "--out", type=pathlib.Path, help="write the JSON lines here as well"
    )
    return parser


class Reporter:
    """Collects the results of one benchmark and writes each as it arrives.

    JSON lines go to standard output and, the same, to a file; `print_table` writes the
    table to standard error.
    """

    def __init__(self, out: str | os.PathLike | None = None):
        """Start with no results.

        Args:
            out: file to write the JSON lines to as well; it is replaced.
        """
        self._rows: list[dict] = []
        self._path = None if out is None else pathlib.Path(out)
        self._versions = library_versions(_VERSIONS)
        self._device = describe_device()
        if self._path is not None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.write_text("", encoding="utf-8")

    def report(
        self,
        *,
        case: str,
        metric: str,
        value: float | None,
        unit: str = "",
        n: int | None = None,
        spread: float | list[float] | None = None,
        peer: str | None = None,
        peer_value: float | None = None,
        target: float | str | None = None,
        met: bool | None = None,
    ) -> None:
        """Write one result.

        Args:
            case: what was measured on.
            metric: what was measured.
            value: the result; what is not finite is written as null.
            unit: its unit, empty for a pure number.
            n: how many objects, runs or draws it rests on.
            spread: its uncertainty, or an interval.
            peer: what it is compared with.
            peer_value: the same metric of the peer.
            target: what it ought to be.
            met: whether it is; None where there is no target.
        """
        row = {
            "case": case,
            "metric": metric,
            "value": value,
            "unit": unit,
            "n": n,
            "spread": spread,
            "peer": peer,
            "peer_value": peer_value,
            "target": target,
            "met": None if met is None else bool(met),
            "versions": self._versions,
            "device": self._device,
        }
        row = _plain(row)
        self._rows.append(row)
        line = json.dumps(row, allow_nan=False, ensure_ascii=False)
        print(line, flush=True)
        if self._path is not None:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(line + "\n")

    def print_table(self) -> None:
        """Write all results as a table to standard error."""
        cells = [list(_COLUMNS)]
        cells += [[_cell(row[name]) for name in _COLUMNS] for row in self._rows]
        widths = [max(len(line[i]) for line in cells) for i in range(len(_COLUMNS))]
        for line in cells:
            padded = (c.ljust(w) for c, w in zip(line, widths, strict=True))
            print("  ".join(padded).rstrip(), file=sys.stderr)


def describe_device() -> str:
    """Say where JAX computes: platform, kind and number of devices, and CPU cores."""
    devices = jax.devices()
    return (
        f"{len(devices)} x {devices[0].device_kind} ({devices[0].platform}), "
        f"{os.cpu_count()} cores"
    )


def _plain(value: object) -> object:
    """Turn NumPy numbers into Python's, and what is not finite into None."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if hasattr(value, "item"):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _cell(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "NO"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
