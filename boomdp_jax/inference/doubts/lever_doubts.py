"""Pinned bodies of which nothing tells where the centre of mass is."""

import numpy as np

from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.physics.params import WORLD
from boomdp_jax.physics.scene_spec import SceneSpec

# Probability of a pin from which it matters.
_LEAST = 0.01


def lever_reasons(spec: SceneSpec, posterior: Posterior) -> list[str]:
    """Reasons for doubt about pinned bodies whose centre of mass is inferred as well.

    About a pin p a body of mass m and radius of gyration k moves by its inertia
    m (k² + |c - p|²) alone, unless gravity acts along the plane: a mass goes with every
    centre c, a circle of centres with every mass. Draws do not spread along all that.

    Args:
        spec: the scene.
        posterior: what was inferred of it.

    Returns:
        One line for each such body.
    """
    params, weights = posterior.params, np.asarray(posterior.weights)
    if params.center_of_mass is None or np.any(np.asarray(spec.scene.gravity) != 0.0):
        return []
    pins = params.revolute
    if pins is None or pins.active.shape[-1] == 0:
        return []
    to_world = np.asarray(pins.active) & (np.asarray(pins.body_b) == WORLD)
    reasons = []
    for body in np.flatnonzero(spec.is_center_unknown):
        is_pinned = np.any(to_world & (np.asarray(pins.body_a) == body), axis=-1)
        if weights @ is_pinned < _LEAST:
            continue
        told = "mass and centre of mass, which cannot be told apart, are"
        if spec.bodies[body].density is not None:
            told = "centre of mass, but for its distance from the pin, is"
        reasons.append(
            f"{spec.names[body]}: of a body on a pin only the inertia about that "
            f"shows; its {told} not to be relied on: expected a known 'center_of_mass'"
        )
    return reasons
