"""Wheels that may be nothing but how a body stands on the floor."""

import numpy as np

from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.physics.scene_spec import SceneSpec

# Probability of both at once from which it matters.
_LEAST = 0.5


def stance_reasons(spec: SceneSpec, posterior: Posterior) -> list[str]:
    """Reasons for doubt about wheels of bodies that rub on the floor as well.

    Where a scene gives no feet a body stands in any way between an even pressure and
    four legs (`stance`). What stands otherwise, on three legs or on a rim, rubs up to
    an eighth differently while it turns, and a wheel beside friction with the floor
    makes up for that: of 16 things on three legs 10 had one, of 16 on a rim 3. A wheel
    without friction with the floor is none of that.

    Args:
        spec: the scene.
        posterior: what was inferred of it.

    Returns:
        One line for each body that may have both and whose feet nobody gave.
    """
    if not spec.unknown.get("wheel", 0):
        return []
    params, weights = posterior.params, np.asarray(posterior.weights)
    has_wheel = np.any(np.asarray(params.wheel.active), axis=-1)
    has_both = has_wheel & np.any(np.asarray(params.ground.active), axis=-1)
    reasons = []
    for index, body in enumerate(spec.bodies):
        probability = float(weights @ has_both[:, index])
        if body.authored_feet is None and probability >= _LEAST:
            reasons.append(
                f"{body.name}: has a wheel beside friction with the floor with "
                f"probability {probability:.2f}; what stands on three legs or a rim "
                "looks like that, and so do several wheels that slip: expected 'feet' "
                "in the scene, got none"
            )
    return reasons
