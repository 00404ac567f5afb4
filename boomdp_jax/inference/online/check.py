"""Whether an online belief's readings follow a law that its model lacks."""

import math

from boomdp_jax.core.history import History
from boomdp_jax.inference.blocks.block import Block, make_block, stack_blocks
from boomdp_jax.inference.doubts.residual import ResidualCheck, check_residuals
from boomdp_jax.inference.online.fit import RefitSettings, in_coordinates_of
from boomdp_jax.inference.online.state import BlockBelief
from boomdp_jax.inference.online.window import windowed
from boomdp_jax.inference.samplers.block_draws import BlockDraws

# Rows that count less than this by forgetting may be of another object. Those that
# count for little are asked as well: of a slow change recent ones alone show nothing,
# and a belief that follows it is late by more than it says.
_LEAST_WEIGHT = math.exp(-3.0)


def _first_row(belief: BlockBelief, num_rows: int, forgetting: float) -> int:
    """First row of a belief's table that its residuals are asked about."""
    begin = int(belief.begin)
    if forgetting < 1.0:
        most = math.floor(math.log(_LEAST_WEIGHT) / math.log(forgetting)) + 1
        begin = max(begin, num_rows - most)
    return begin


def check_online(
    settings: RefitSettings,
    history: History,
    num_rows: int,
    block: Block,
    belief: BlockBelief,
    draws: BlockDraws,
) -> ResidualCheck:
    """Look for laws that a block's belief lacks, as `infer` does.

    Args:
        settings: of the belief.
        history: the whole table.
        num_rows: rows of it in use.
        block: bodies that may interact.
        belief: in the block.
        draws: its particles.

    Returns:
        What was found; nothing where rows are few.
    """
    begin = _first_row(belief, num_rows, settings.forgetting)
    if num_rows <= begin:
        return ResidualCheck(0, [], [])
    window = windowed(history, begin, num_rows, None)
    asked = make_block(
        settings.spec, block.bodies, window, is_uniform=settings.is_uniform
    )
    target = in_coordinates_of(belief, asked.target)
    return check_residuals(stack_blocks([asked._replace(target=target)]), draws)[0]
