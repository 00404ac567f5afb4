"""Draws of coordinates made `Params`, many at a time, by one compiled program."""

import jax
import numpy as np

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.inference.hypotheses.coordinates import Coordinates
from boomdp_jax.physics.params import Params

_DRAWS_PER_CALL = 1024


@QuickCompile
def _decode_some(coordinates, z, active):
    return jax.vmap(coordinates)(z, active)


def decode(
    coordinates: Coordinates,
    z: np.ndarray,
    active: np.ndarray,
    draws_per_call: int = _DRAWS_PER_CALL,
) -> Params:
    """Params of many draws, on the host.

    Args:
        coordinates: of their block.
        z: coordinates of each, `[draw, dim]`.
        active: inferred slots that are active, `[draw, slot]`.
        draws_per_call: decoded by one call of the compiled program, whatever their
            number; it is compiled for each such size.

    Returns:
        Φ of each, leading axis `draw`.
    """
    num = len(z)
    parts = []
    for begin in range(0, num, draws_per_call):
        rows = np.minimum(np.arange(begin, begin + draws_per_call), num - 1)
        part = _decode_some(
            coordinates, on_device(z[rows], z.dtype), on_device(active[rows], bool)
        )
        parts.append(jax.tree.map(np.asarray, part))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:num], *parts)
