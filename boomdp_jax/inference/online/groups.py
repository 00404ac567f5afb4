"""Blocks of an online belief that are equal in shape, side by side in one array."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np

from boomdp_jax.core.arrays import row_of
from boomdp_jax.core.compile_ahead import signature
from boomdp_jax.inference.blocks.block import Block
from boomdp_jax.inference.online.state import BlockBelief


class BlockGroups(NamedTuple):
    """Independent blocks of a scene, and which of them share an array."""

    blocks: tuple[Block, ...]
    groups: tuple[tuple[int, ...], ...]
    """Indices of blocks of equal shapes."""

    @classmethod
    def of(cls, blocks: Sequence[Block]) -> "BlockGroups":
        """Group blocks by shape, in the order in which shapes first occur."""
        groups: dict[object, list[int]] = {}
        for index, block in enumerate(blocks):
            groups.setdefault(signature(block.target), []).append(index)
        return cls(tuple(blocks), tuple(map(tuple, groups.values())))

    @property
    def bodies(self) -> tuple[tuple[tuple[int, ...], ...], ...]:
        """Bodies of each block, group by group."""
        return tuple(tuple(self.blocks[i].bodies for i in g) for g in self.groups)

    @property
    def order(self) -> tuple[int, ...]:
        """Indices of all blocks, group by group."""
        return tuple(index for group in self.groups for index in group)

    def parts(self, beliefs: Sequence[BlockBelief]) -> list[tuple[Block, BlockBelief]]:
        """Each block, and what is believed of it, group by group.

        Args:
            beliefs: of each group, with a leading axis of its blocks.
        """
        return [
            (self.blocks[index], row_of(stacked, place))
            for group, stacked in zip(self.groups, beliefs, strict=True)
            for place, index in enumerate(group)
        ]

    def stacked(self, beliefs: Mapping[int, BlockBelief]) -> tuple[BlockBelief, ...]:
        """Beliefs of all blocks by index as one entry for each group."""
        return tuple(
            jax.tree.map(
                lambda *leaves: jax.device_put(
                    np.stack([np.asarray(leaf) for leaf in leaves])
                ),
                *(beliefs[index] for index in group),
            )
            for group in self.groups
        )
