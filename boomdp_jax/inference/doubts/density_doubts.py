"""Densities far from all that is expected, as wrong units make them.

Of a body on a pin or in a drawer nothing but the prior tells metres from millimetres,
or newtons from the weight of a gram: all fits as well, and the mass is a thousand times
too small or too large.
"""

import numpy as np

from boomdp_jax.inference.hypotheses.prior import read_prior
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.physics.scene_spec import SceneSpec

# How many of its prior's sds the logarithm of a density may be off: by a factor of 140.
# A sheet of paper is 4.0 off, a block of steel 40 cm high 3.1, a table in centimetres
# 3.3, in millimetres 4.9.
_MOST = 3.3


def density_reasons(spec: SceneSpec, posterior: Posterior) -> list[str]:
    """Reasons for doubt about densities that are far from their prior.

    Args:
        spec: the scene.
        posterior: what was inferred of it.

    Returns:
        One line for each such body.
    """
    scale = read_prior(spec.prior, spec.source).scales["density"]
    weights = np.asarray(posterior.weights, float)
    logs = weights @ np.log(np.asarray(posterior.params.density, float))
    reasons = []
    for body, shape in enumerate(spec.bodies):
        if shape.is_static or shape.density is not None:
            continue
        sds = (logs[body] - np.log(scale.center)) / scale.spread
        if abs(sds) > _MOST:
            reasons.append(
                f"{spec.names[body]}: a density of {np.exp(logs[body]):.2g} kg/m² is "
                f"{abs(sds):.1f} sds off what is expected, {scale.center:g} kg/m² give "
                f"or take a factor of {np.exp(scale.spread):.2g}: expected metres, "
                "newtons and seconds in outlines and recordings, or a prior of its "
                "density"
            )
    return reasons
