"""The blocks of many scenes as sampling problems, in groups that share a call."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

from boomdp_jax.core.compile_ahead import signature
from boomdp_jax.core.history import History
from boomdp_jax.inference.blocks.block import Block, make_block
from boomdp_jax.inference.doubts.still import bodies_let_be, let_be_note
from boomdp_jax.inference.likelihoods.choice import ChosenLikelihood
from boomdp_jax.inference.members import Refusals
from boomdp_jax.inference.readings.components import independent_blocks
from boomdp_jax.inference.readings.outliers import without_isolated
from boomdp_jax.inference.readings.touching import find_touching
from boomdp_jax.physics.scene_spec import SceneSpec

Numbered = tuple[int, Block]
"""A block, and the number of its scene."""


class BatchBlocks(NamedTuple):
    """What is to be inferred of many scenes."""

    groups: list[list[Numbered]]
    """Blocks whose targets have the same static parts and array shapes."""
    notes: list[list[str]]
    """Of each scene."""

    @property
    def num_blocks(self) -> int:
        """How many blocks there are."""
        return sum(map(len, self.groups))


def blocks_of_batch(
    specs: Sequence[SceneSpec],
    histories: Sequence[History],
    likelihood: ChosenLikelihood,
    freedom: float | None,
) -> BatchBlocks:
    """Split scenes into blocks that do not interact.

    Args:
        specs: the scenes.
        histories: one for each, of few different capacities.
        likelihood: of the readings.
        freedom: degrees of freedom of the readings' Student-t noise; None: normal.

    Returns:
        The blocks.

    Raises:
        MemberError: scenes that cannot be inferred, all that there are.
    """
    problems: list[Numbered] = []
    notes: list[list[str]] = []
    refusals = Refusals(len(specs))
    for index, (spec, history) in enumerate(zip(specs, histories, strict=True)):
        with refusals.of(index):
            blocks, own = _blocks_of_scene(spec, history, likelihood, freedom)
            problems += [(index, block) for block in blocks]
            notes.append(own)
    refusals.check()
    groups: dict[object, list[Numbered]] = {}
    for problem in problems:
        groups.setdefault(signature(problem[1].target), []).append(problem)
    return BatchBlocks(list(groups.values()), notes)


def _blocks_of_scene(
    spec: SceneSpec,
    history: History,
    likelihood: ChosenLikelihood,
    freedom: float | None,
) -> tuple[list[Block], list[str]]:
    """Blocks of one scene, and notes."""
    trusted = history if freedom is None else without_isolated(history)
    touching = find_touching(spec, trusted)
    blocks, screened = independent_blocks(spec, trusted, touching)
    missing = [likelihood.notes_on_rows(spec, b, history) for b in blocks]
    let_be = {(body,) for body in bodies_let_be(spec, trusted, touching)}
    let_be &= set(blocks)
    left_out = [let_be_note(spec, body) for (body,) in sorted(let_be)]
    notes = [*screened, *left_out, *itertools.chain(*missing)]
    return [
        make_block(
            spec,
            bodies,
            history,
            touching=touching,
            freedom=freedom,
            is_told=bodies not in let_be,
            cuts_turns=True,
        )
        for bodies in blocks
    ], notes
