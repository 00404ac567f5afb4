"""What a posterior's diagnostics tell of the evidence of every structure."""

from typing import NamedTuple

import numpy as np

from boomdp_jax.inference.blocks.block import Block
from boomdp_jax.inference.blocks.fixed_structure import structure_of_slots
from boomdp_jax.inference.doubts.residual import ResidualCheck
from boomdp_jax.inference.samplers.block_draws import BlockDraws
from boomdp_jax.physics.params import WORLD
from boomdp_jax.physics.scene_spec import SceneSpec

# Structures of each block that are listed.
_MOST_ROWS = 32


class BlockResult(NamedTuple):
    """A block and its place in a batch of draws."""

    block: Block
    draws: BlockDraws
    place: int
    residual: ResidualCheck | None = None
    """None: it was not looked for laws that are missing."""


def report_evidence(spec: SceneSpec, results: list[BlockResult]) -> dict:
    """Evidence of structures, most probable first, block by block.

    Args:
        spec: the scene.
        results: its blocks.

    Returns:
        `log_evidence_error`, the standard error of the whole scene's log-evidence, and
        `evidence`: per block its `bodies` and `structures`, each of these with its
        constraints, `log_evidence`, `error`, `probability` and `probability_error`;
        an error that the method does not know is NaN.
        Structures that mean the same by symmetry are listed apart here, which is how
        they are sampled.
    """
    tables, variance = [], 0.0
    for block, draws, place, _ in results:
        evidence = draws.evidence
        if evidence is None:
            return {"log_evidence_error": None, "evidence": []}
        variance += float(evidence.total_error[place]) ** 2
        order = np.argsort(-evidence.probability[place], kind="stable")
        rows = [
            {
                "constraints": _constraints(spec, block, int(index)),
                "log_evidence": float(evidence.log_evidence[place, index]),
                "error": float(evidence.error[place, index]),
                "probability": float(evidence.probability[place, index]),
                "probability_error": float(evidence.probability_error[place, index]),
            }
            for index in order[:_MOST_ROWS]
        ]
        names = [spec.names[body] for body in block.bodies]
        tables.append({"bodies": names, "structures": rows})
    return {"log_evidence_error": float(np.sqrt(variance)), "evidence": tables}


def _constraints(spec: SceneSpec, block: Block, index: int) -> dict[str, list]:
    """Constraints of one structure by body, as `structure=` of `infer` takes them."""
    active = np.asarray(block.target.structures[index])
    slots = [
        slot._replace(
            body_a=block.bodies[slot.body_a],
            body_b=WORLD if slot.body_b == WORLD else block.bodies[slot.body_b],
        )
        for slot, is_active in zip(block.layout.slots, active, strict=True)
        if is_active
    ]
    return structure_of_slots(spec, slots)
