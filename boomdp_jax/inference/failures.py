"""What inference refused of a sweep, told when everything else is done."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from boomdp_jax.inference.members import MemberError
from boomdp_jax.inference.posteriors.posterior import Posterior

# So many are listed in one message.
_MOST_LISTED = 10


class SweepError(ValueError):
    """Objects of a sweep that inference refused; all others are done."""

    failed: dict[int, str]
    """A line for each, by number of the object."""
    paths: list[Path]
    """Files of the others, in order."""

    def __init__(
        self,
        text: str,
        failed: Mapping[int, str] | None = None,
        paths: Sequence[Path] = (),
    ):
        # All else that makes up an exception follows from its text when it is sent to
        # another process.
        super().__init__(text)
        self.failed = dict(failed or {})
        self.paths = list(paths)


def all_but_refused(
    numbers: Sequence[int], infer: Callable[[list[int]], list[Posterior]]
) -> tuple[dict[int, Posterior], dict[int, str]]:
    """Infer objects together, without those that are refused.

    They are refused before anything is inferred, each for its own recording and scene:
    who shares a call with whom does not depend on when this is found.

    Args:
        numbers: of the objects.
        infer: posteriors of some of them, as `infer_batch` gives them.

    Returns:
        Posteriors, and why others have none, by number.

    Raises:
        ValueError: no objects.
    """
    if not numbers:
        raise ValueError("unit: expected one that the sweep has, got one of no objects")
    left, refused = list(numbers), {}
    while left:
        try:
            return dict(zip(left, infer(left), strict=True)), refused
        except MemberError as error:
            refused |= {left[place]: line for place, line in error.messages.items()}
            left = [number for number in left if number not in refused]
    return {}, refused


def all_done(
    folder: Path, failed: Mapping[int, str], paths: Sequence[Path]
) -> list[Path]:
    """Files of a sweep whose units are done.

    Args:
        folder: of the sweep.
        failed: a line for each object that failed, by its number.
        paths: files of the others, in order.

    Returns:
        Those files.

    Raises:
        SweepError: an object failed.
    """
    if failed:
        lines = listing(list(failed.values()))
        raise SweepError(
            f"{folder}: expected posteriors of {len(failed) + len(paths)} objects, got "
            f"{len(paths)}; the others were refused: {lines}",
            failed,
            paths,
        )
    return list(paths)


def listing(lines: Sequence[str]) -> str:
    """Several messages in one line, at most ten of them."""
    more = len(lines) - _MOST_LISTED
    rest = [f"and {more} more"] if more > 0 else []
    return "; ".join([*lines[:_MOST_LISTED], *rest])
