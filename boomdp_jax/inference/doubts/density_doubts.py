"""Densities far from all that is expected, as wrong units make them.

Of a body on a pin or in a drawer nothing but the prior tells metres from millimetres,
or newtons from the weight of a gram: all fits as well, and the mass is a thousand times
too small or too large.
"""

import numpy as np

from boomdp_jax.core.history import History
from boomdp_jax.inference.hypotheses.prior import read_prior
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.inference.readings.reading_sequence import readings_in_order
from boomdp_jax.physics.scene_spec import SceneSpec

# How many of its prior's sds the logarithm of a density may be off, and where a body
# has gone as many times its own size.
_MOST, _MOST_FAR, _FAR = 3.0, 2.0, 50.0


def density_reasons(
    spec: SceneSpec, history: History, posterior: Posterior
) -> list[str]:
    """Reasons for doubt about densities that are far from their prior.

    Args:
        spec: the scene.
        history: its readings.
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
        far = _times_its_size(spec, history, body)
        if abs(sds) <= (_MOST if far < _FAR else _MOST_FAR):
            continue
        went = f" (and it went {far:.0f} times its own size)" if far >= _FAR else ""
        reasons.append(
            f"{spec.names[body]}: a density of {np.exp(logs[body]):.2g} kg/m² is "
            f"{abs(sds):.1f} sds off what is expected, {scale.center:g} kg/m² give or "
            f"take a factor of {np.exp(scale.spread):.2g}{went}: expected metres, "
            "newtons and seconds in outlines and recordings, or a prior of its density"
        )
    return reasons


def _times_its_size(spec: SceneSpec, history: History, body: int) -> float:
    """How far apart a body was seen, over the farthest point of its outline."""
    shape = spec.bodies[body]
    place = readings_in_order(spec, history).values[:, body, :2]
    place = place[np.isfinite(place).all(axis=-1)]
    if len(place) == 0:
        return 0.0
    corners = np.linalg.norm(shape.outline, axis=1)
    reach = float(np.max(corners, initial=0.0)) + shape.radius
    return float(np.max(np.ptp(place, axis=0)) / reach)
