"""Lists of points of many objects and structures, in chunks of equal ones.

The points of a chunk share an object and a structure, so that what belongs to those is
read once for a chunk and products with it vectorise. A call of a compiled program takes
up to `max_chunks()` chunks of up to `MAX_OWNERS` objects and structures, and does as
much work as there are: the number of chunks is not compiled in.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

CHUNK_SIZE = 64
"""Points of a chunk."""

MAX_OWNERS = 8
"""Pairs of object and structure in one call."""


def max_chunks() -> int:
    """Chunks of one call.

    On a CPU one chunk is worked at after the other, and results take memory for all of
    them, which costs more than a call once rows are some hundred. Others need many.
    """
    return 8 if jax.default_backend() == "cpu" else 32


class Call(NamedTuple):
    """Which points one call takes, on the host."""

    owners: np.ndarray
    """Object and structure of each owner, `[owner, 2]`, padded."""
    owner: np.ndarray
    """Owner of each chunk, `[chunk]`, padded."""
    num: np.ndarray
    """Chunks that count, a scalar."""
    rows: np.ndarray
    """Which point fills each place, `[chunk, place]`, padded."""


class Chunking(NamedTuple):
    """Which points go together, and back again; on the host."""

    owner: np.ndarray
    """Object and structure of each chunk, `[chunk, 2]`."""
    source: np.ndarray
    """Which point fills each place, `[chunk, place]`; places left over repeat one."""
    num_points: int

    @classmethod
    def of(
        cls,
        index: np.ndarray,
        structure: np.ndarray,
        num_structures: int,
        *,
        size: int = CHUNK_SIZE,
    ) -> "Chunking":
        """Sort points by object and structure.

        Args:
            index: object of each point.
            structure: of each point.
            num_structures: of each object.
            size: points of a chunk.
        """
        group = index.astype(np.int64) * num_structures + structure
        order = np.argsort(group, kind="stable")
        names, begins, sizes = np.unique(
            group[order], return_index=True, return_counts=True
        )
        counts = -(-sizes // size)
        owner = np.repeat(names, counts)
        firsts = np.cumsum(counts) - counts
        # Place of each chunk within its group, in chunks.
        rank = np.arange(len(owner)) - np.repeat(firsts, counts)
        place = rank[:, None] * size + np.arange(size)
        is_real = place < np.repeat(sizes, counts)[:, None]
        begin = np.repeat(begins, counts)[:, None]
        source = order[begin + np.where(is_real, place, 0)] if len(order) else place
        pairs = np.stack(np.divmod(owner, num_structures), axis=1)
        return cls(pairs, source, len(index))

    def calls(self, num_workers: int) -> Iterator[Call]:
        """The chunks dealt out to calls, one after the other.

        Args:
            num_workers: how many calls can be made at a time; there are as many calls
                if there are chunks enough.
        """
        total = len(self.owner)
        num_places = max_chunks()
        most = min(num_places, max(-(-total // num_workers), 1))
        is_new = np.ones(total, bool)
        is_new[1:] = np.any(self.owner[1:] != self.owner[:-1], axis=1)
        number = np.cumsum(is_new) - 1
        begin = 0
        while begin < total:
            end = min(begin + most, total)
            within = number[begin:end] - number[begin]
            num = int(np.searchsorted(within, MAX_OWNERS))
            within = within[:num]
            first = begin + np.flatnonzero(np.diff(within, prepend=-1))
            owners = np.resize(self.owner[first], (MAX_OWNERS, 2))
            owners[len(first) :] = self.owner[begin]
            chunk = np.minimum(begin + np.arange(num_places), begin + num - 1)
            owner = np.zeros(num_places, np.int32)
            owner[:num] = within
            count = np.array(num, np.int32)
            yield Call(owners.astype(np.int32), owner, count, self.source[chunk])
            begin += num

    def in_order(self, found: list[np.ndarray]) -> np.ndarray:
        """Results of all calls, `[chunk, place, ...]` each, as a list of points.

        Args:
            found: only of the chunks that count.
        """
        joined = np.concatenate(found)
        joined = joined.reshape(-1, *joined.shape[2:])
        out = np.empty((self.num_points, *joined.shape[1:]), joined.dtype)
        out[self.source.reshape(-1)] = joined
        return out


def for_each_chunk(
    function: Callable[[Any, Any], Any],
    known: Any,
    owner: Int[Array, " chunk"],
    num: Int[Array, ""],
    points: Any,
) -> Any:
    """Apply a function to the first chunks of a call.

    Args:
        function: from what an owner knows and the points of a chunk, leading axis
            `place`, to a tree of arrays.
        known: by each owner, leading axis `owner`.
        owner: of each chunk.
        num: how many chunks count.
        points: leading axes `chunk` and `place`.

    Returns:
        What the function returns for each chunk, leading axis `chunk`; of those that
        do not count, anything.
    """

    # Compiled with the rest, but its Python runs once for both uses below.
    @jax.jit
    def one(number):
        ours = jax.tree.map(lambda leaf: leaf[owner[number]], known)
        return function(ours, jax.tree.map(lambda leaf: leaf[number], points))

    if jax.default_backend() != "cpu":
        return jax.vmap(one)(jnp.arange(len(owner)))
    # One after the other: with a batch axis of their own, what the points of a chunk
    # share would have to be spread over all of them before every small loop. That takes
    # twice as long, and the extended filter four times.
    first = jnp.zeros_like(num)
    start = jax.tree.map(
        lambda leaf: jnp.zeros((len(owner), *leaf.shape), leaf.dtype),
        jax.eval_shape(one, first),
    )

    def add(number, found):
        return jax.tree.map(
            lambda all_, leaf: jax.lax.dynamic_update_index_in_dim(
                all_, leaf, number, 0
            ),
            found,
            one(number),
        )

    return jax.lax.fori_loop(first, num, add, start)
