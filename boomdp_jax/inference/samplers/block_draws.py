"""What sampling a batch of equal blocks gives, whatever the method."""

from typing import NamedTuple

import numpy as np

from boomdp_jax.inference.samplers.chain_diagnostics import ChainDiagnostics
from boomdp_jax.inference.samplers.structure_evidence import StructureEvidence


class BlockDraws(NamedTuple):
    """What sampling a batch of equal blocks gives; leading axis `object`, on the host.

    `[object, draw, ...]` unless a field says otherwise.
    """

    structure: np.ndarray
    z: np.ndarray
    """`[object, draw, dim]`."""
    log_density: np.ndarray
    noise_scale: np.ndarray
    """Of readings, `[object, draw, body, 4]`."""
    impulse_scale: np.ndarray | None
    """Of the motion, `[object, draw, body, 2]`; None where it is taken as exact."""
    log_evidence: np.ndarray
    """`[object]`."""
    evidence: StructureEvidence | None
    """Of every structure; None where the method gives none."""
    diagnostics: list[ChainDiagnostics]
    chain_index: np.ndarray
    """Index of each chain; draws lie chain after chain."""
