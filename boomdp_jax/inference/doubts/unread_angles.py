"""Bodies that were seen and whose angle was not, as a tracked dot is."""

import numpy as np

from boomdp_jax.core.history import History
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.physics.scene_spec import SceneSpec

# Probability of a constraint from which it matters.
_LEAST = 0.01
# Constraints of one body and another or the world, and those of one alone, of which an
# angle says where they are.
_OF_TWO = ("revolute", "distance", "prismatic", "weld")
_ANGLE = 2


def angle_reasons(spec: SceneSpec, history: History, posterior: Posterior) -> list[str]:
    """Reasons for doubt about constraints of bodies whose angle was never read.

    A filter follows a body from an angle that is roughly known. Where it is not, the
    same positions may be those of a pin, of a wheel, or of a heavier body that is free,
    and what is found first stays, whatever its probability.

    Args:
        spec: the scene.
        history: its readings.
        posterior: what was inferred of it.

    Returns:
        One line for each body that may have a joint or a wheel.
    """
    rows = np.asarray(history.mask)
    is_read = np.zeros((spec.num_bodies, 6), bool)
    for mask in (history.state_mask, history.next_state_mask):
        is_read |= np.any(np.asarray(mask)[rows], axis=0)
    is_unread = np.any(is_read, axis=1) & ~is_read[:, _ANGLE]
    is_unread &= ~np.asarray(spec.is_static)
    may_be_held = any(spec.unknown.get(kind, 0) for kind in ("wheel", *_OF_TWO))
    weights, reasons = np.asarray(posterior.weights), []
    for body in np.flatnonzero(is_unread):
        probability = weights @ _is_held(posterior, int(body))
        if may_be_held or probability >= _LEAST:
            reasons.append(
                f"{spec.names[body]}: its angle was never read; whether it has a joint "
                f"or a wheel, here with probability {probability:.2f}, and its mass "
                "are not to be relied on: expected some readings of the angle"
            )
    return reasons


def _is_held(posterior: Posterior, body: int) -> np.ndarray:
    """Of each draw, whether a body has a joint or a wheel."""
    params = posterior.params
    is_held = np.any(np.asarray(params.wheel.active)[:, body], axis=-1)
    for kind in _OF_TWO:
        slots = getattr(params, kind)
        if slots is None or slots.active.shape[-1] == 0:
            continue
        is_its = np.asarray(slots.body_a) == body
        is_its = is_its | (np.asarray(slots.body_b) == body)
        is_held = is_held | np.any(np.asarray(slots.active) & is_its, axis=-1)
    return is_held
