"""Lists of points of many objects and structures, in chunks of equal ones.

The points of a chunk share an object and a structure, so that what belongs to those is
read once for a chunk and products with it vectorise. A call of a compiled program takes
up to `max_chunks()` chunks of up to `MAX_OWNERS` objects and structures, and does as
much work as there are: the number of chunks is not compiled in.

Where a step costs far more than such products, chunks are filled with points of any
structures of one object instead: of a pair of bodies there may be a hundred structures
and a few points of each.
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

MAX_MIXED_OWNERS = CHUNK_SIZE
"""The same where chunks have points of several structures."""


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
    """Owner of each chunk `[chunk]`, or of each place `[chunk, place]`, padded."""
    num: np.ndarray
    """Chunks that count, a scalar."""
    rows: np.ndarray
    """Which point fills each place, `[chunk, place]`, padded."""


class Chunking(NamedTuple):
    """Which points go together, and back again; on the host."""

    names: np.ndarray
    """Objects and structures, in order, `[name, 2]`."""
    number: np.ndarray
    """Which of them each place has, `[chunk, place]`."""
    source: np.ndarray
    """Which point fills each place, `[chunk, place]`; places left over repeat one."""
    num_points: int
    is_mixed: bool

    @classmethod
    def of(
        cls,
        index: np.ndarray,
        structure: np.ndarray,
        num_structures: int,
        *,
        size: int = CHUNK_SIZE,
        is_mixed: bool = False,
    ) -> "Chunking":
        """Sort points by object and structure.

        Args:
            index: object of each point.
            structure: of each point.
            num_structures: of each object.
            size: points of a chunk.
            is_mixed: whether the points of a chunk share an object only.
        """
        group = index.astype(np.int64) * num_structures + structure
        order = np.argsort(group, kind="stable")
        group = group[order]
        is_new = np.diff(group, prepend=-1) > 0
        names = np.stack(np.divmod(group[is_new], num_structures), axis=1)
        shared = index[order] if is_mixed else group
        _, begins, sizes = np.unique(shared, return_index=True, return_counts=True)
        counts = -(-sizes // size)
        firsts = np.cumsum(counts) - counts
        # Place of each chunk within what it shares, in chunks.
        rank = np.arange(counts.sum()) - np.repeat(firsts, counts)
        place = rank[:, None] * size + np.arange(size)
        place = np.minimum(place, np.repeat(sizes, counts)[:, None] - 1)
        rows = np.repeat(begins, counts)[:, None] + place
        number = (np.cumsum(is_new) - 1)[rows]
        return cls(names, number, order[rows], len(index), is_mixed)

    @property
    def num_chunks(self) -> int:
        """How many chunks there are."""
        return len(self.source)

    def calls(self, num_workers: int) -> Iterator[Call]:
        """The chunks dealt out to calls, one after the other.

        Args:
            num_workers: how many calls can be made at a time; there are as many calls
                if there are chunks enough.
        """
        total, num_places = self.num_chunks, max_chunks()
        most = min(num_places, max(-(-total // num_workers), 1))
        most_owners = MAX_MIXED_OWNERS if self.is_mixed else MAX_OWNERS
        begin = 0
        while begin < total:
            base = self.number[begin, 0]
            within = self.number[begin : begin + most] - base
            num = int(np.searchsorted(within[:, -1], most_owners))
            within = within[:num]
            count = int(within[-1, -1]) + 1
            owners = np.tile(self.names[base], (most_owners, 1))
            owners[:count] = self.names[base : base + count]
            chunk = np.minimum(begin + np.arange(num_places), begin + num - 1)
            owner = np.zeros((num_places, within.shape[1]), np.int32)
            owner[:num] = within
            yield Call(
                owners.astype(np.int32),
                owner if self.is_mixed else owner[:, 0],
                np.array(num, np.int32),
                self.source[chunk],
            )
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
