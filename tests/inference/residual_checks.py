"""Residual checks of boxes whose mass and noise are known."""

import numpy as np

from boomdp_jax.core.history import History
from boomdp_jax.inference.blocks.block import make_block, stack_blocks
from boomdp_jax.inference.doubts.residual import ResidualCheck, check_residuals
from boomdp_jax.inference.samplers.block_draws import BlockDraws
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict
from tests.inference.recordings import AREA, DT, MASS, SIZE

READING = np.array([1e-3, 1e-3, 5e-3, 5e-3])
IMPULSE = np.array([0.05, 0.05])
"""Of a motion that the model does not know well [m/s, rad/s]."""


def known_boxes(num: int = 1) -> SceneSpec:
    """Boxes of the right mass that do not touch."""
    body = {
        "shape": {"type": "box", "half_extents": list(SIZE)},
        "density": MASS / AREA,
    }
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": DT,
            "bodies": [{"name": f"box{i}", **body} for i in range(num)],
        },
        source="test",
    )


def check(
    histories: list[History],
    spec: SceneSpec | None = None,
    impulse: np.ndarray = IMPULSE,
    z: np.ndarray | None = None,
) -> list[ResidualCheck]:
    """With the noise of readings known, all bodies in one block.

    Coordinates are given, or zero where there are none that matter.
    """
    spec = known_boxes() if spec is None else spec
    num_bodies = spec.num_bodies
    blocks = [make_block(spec, tuple(range(num_bodies)), each) for each in histories]
    targets = stack_blocks(blocks)
    num = len(histories)
    z = np.zeros(targets.slot.shape[1]) if z is None else z
    draws = BlockDraws(
        structure=np.zeros((num, 2), int),
        z=np.tile(z, (num, 2, 1)),
        log_density=np.tile([np.nan, 0.0], (num, 1)),
        noise_scale=np.tile(READING, (num, 2, num_bodies, 1)),
        impulse_scale=np.tile(impulse, (num, 2, num_bodies, 1)),
        log_evidence=np.zeros(num),
        evidence=None,
        diagnostics=[],
        chain_index=np.zeros(1, int),
    )
    return check_residuals(targets, draws)


def assert_names(found: ResidualCheck, name: str, expected, num_sds: float = 4.0):
    """The best law is this one, decisively, with these coefficients."""
    best = found.laws[0]
    assert best.law.name == name
    assert best.fit.log_bayes_factor > 10.0
    error = np.abs(best.fit.coefficient - np.array(expected))
    assert np.all(error < num_sds * best.fit.sd)
