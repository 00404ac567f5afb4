"""Lists of points of many objects and structures, in chunks of equal ones."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np


class Chunking(NamedTuple):
    """Which points go together, and back again; on the host."""

    owner: np.ndarray
    """Object and structure of each chunk, `[chunk, 2]`."""
    source: np.ndarray
    """Which point fills each place, `[chunk, place]`; places left over repeat one."""
    num_chunks: int
    """Without those that fill up the last call."""
    num_points: int
    per_call: int

    @classmethod
    def of(
        cls,
        index: np.ndarray,
        structure: np.ndarray,
        num_structures: int,
        *,
        size: int = 16,
        per_call: int = 4,
    ) -> "Chunking":
        """Sort points by object and structure.

        Args:
            index: object of each point.
            structure: of each point.
            num_structures: of each object.
            size: points of a chunk.
            per_call: chunks of a call.
        """
        group = index.astype(np.int64) * num_structures + structure
        order = np.argsort(group, kind="stable")
        names, begins, sizes = np.unique(
            group[order], return_index=True, return_counts=True
        )
        counts = -(-sizes // size)
        total = int(counts.sum())
        padded = -(-total // per_call) * per_call
        source = np.zeros((padded, size), np.int64)
        owner = np.zeros(padded, np.int64)
        first = 0
        for name, begin, num, count in zip(names, begins, sizes, counts, strict=True):
            places = np.full(count * size, order[begin])
            places[:num] = order[begin : begin + num]
            source[first : first + count] = places.reshape(count, size)
            owner[first : first + count] = name
            first += count
        if first:
            source[first:], owner[first:] = source[0, 0], owner[0]
        pairs = np.stack(np.divmod(owner, num_structures), axis=1)
        return cls(pairs, source, total, len(index), per_call)

    def calls(self) -> Iterator[tuple[tuple[np.ndarray, np.ndarray], np.ndarray]]:
        """Object and structure of a call's chunks, and their points, call by call."""
        for begin in range(0, len(self.owner), self.per_call):
            rows = slice(begin, begin + self.per_call)
            yield (self.owner[rows, 0], self.owner[rows, 1]), self.source[rows]

    def in_order(self, found: list[np.ndarray]) -> np.ndarray:
        """Results of all calls, `[chunk, place, ...]` each, as a list of points."""
        flat = self.source[: self.num_chunks].reshape(-1)
        joined = np.concatenate(found)
        joined = joined.reshape(-1, *joined.shape[2:])[: flat.size]
        out = np.empty((self.num_points, *joined.shape[1:]), joined.dtype)
        out[flat] = joined
        return out
