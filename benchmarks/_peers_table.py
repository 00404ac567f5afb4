"""The comparison as a table for people: one row for each scene, batch and engine."""

import dataclasses
import sys

from _peers_program import Timing


@dataclasses.dataclass(frozen=True)
class Row:
    """What was measured of one engine on one batch of a scene."""

    case: str
    batch: int
    engine: str
    timing: Timing
    world_steps: int
    """Steps of all worlds in one run."""
    num_bodies: int
    """Moving bodies of a world."""
    compile_seconds: float | None

    @property
    def rate(self) -> float:
        """Body-steps a second, fastest run."""
        return self.world_steps * self.num_bodies / self.timing.fastest

    @property
    def wall(self) -> float:
        """Wall microseconds for a step of one world, median run."""
        return 1e6 * self.timing.median / self.world_steps

    @property
    def cpu(self) -> float:
        """CPU microseconds for a step of one world, over all threads, median run."""
        return 1e6 * self.timing.cpu_median / self.world_steps


OURS = "boomdp_jax"
"""Name of our own engine."""

_COLUMNS = (
    "scene",
    "batch",
    "engine",
    "body-steps/s",
    "wall us",
    "CPU us",
    "compile s",
    "rate ours/peer",
    "CPU peer/ours",
)


def print_rows(rows: list[Row]) -> None:
    """Write speeds to standard error.

    Args:
        rows: what was measured.
    """
    lines = [list(_COLUMNS)]
    for row in rows:
        own = find(rows, row.case, row.batch)
        seconds = row.compile_seconds
        lines.append(
            [
                row.case,
                str(row.batch),
                row.engine,
                f"{row.rate:.3g}",
                f"{row.wall:.3g}",
                f"{row.cpu:.3g}",
                "" if seconds is None else f"{seconds:.1f}",
                "" if own is None else f"{ratio(own.rate, row.rate):.3g}",
                "" if own is None else f"{ratio(row.cpu, own.cpu):.3g}",
            ]
        )
    print_lines(lines)


def print_lines(lines: list[list[str]]) -> None:
    """Write cells to standard error, columns aligned, and an empty line.

    Args:
        lines: rows of one length.
    """
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for line in lines:
        padded = (cell.ljust(width) for cell, width in zip(line, widths, strict=True))
        print("  ".join(padded).rstrip(), file=sys.stderr)
    print(file=sys.stderr)


def find(rows: list[Row], case: str, batch: int, engine: str = OURS):
    """The row of an engine on a batch of a scene; None if there is none."""
    for row in rows:
        if (row.case, row.batch, row.engine) == (case, batch, engine):
            return row
    return None


def ratio(above: float, below: float) -> float:
    """A ratio that is infinite, not an error, where a clock is too coarse."""
    return above / below if below > 0 else float("inf")
