"""What is said of a posterior besides what its own draws and filters tell."""

import numpy as np

from boomdp_jax.core.history import History
from boomdp_jax.inference.doubts.angle_sense import angle_sense_reasons
from boomdp_jax.inference.doubts.density_doubts import density_reasons
from boomdp_jax.inference.doubts.drag_doubts import drag_reasons
from boomdp_jax.inference.doubts.end_stops import end_stop_reasons
from boomdp_jax.inference.doubts.known_joints import known_joint_reasons
from boomdp_jax.inference.doubts.lever_doubts import lever_reasons
from boomdp_jax.inference.doubts.noise_doubts import noise_reasons
from boomdp_jax.inference.doubts.pose_velocity_agreement import pose_velocity_notes
from boomdp_jax.inference.doubts.run_breaks import run_break_reasons
from boomdp_jax.inference.doubts.stance_doubts import stance_reasons
from boomdp_jax.inference.doubts.still import still_notes, still_reasons
from boomdp_jax.inference.doubts.unread_angles import angle_reasons
from boomdp_jax.inference.doubts.velocity_doubts import velocity_reasons
from boomdp_jax.inference.posteriors.posterior import Posterior, with_diagnostics
from boomdp_jax.inference.readings.unread import unread_notes
from boomdp_jax.physics.scene_spec import SceneSpec


def with_notes(posterior: Posterior, notes: list[str]) -> Posterior:
    """The same with further notes, which cast no doubt on it."""
    if not notes:
        return posterior
    before = posterior.diagnostics.get("notes", [])
    return with_diagnostics(posterior, (), {"notes": [*before, *notes]})


def with_doubts(
    posterior: Posterior, spec: SceneSpec, history: History, notes: list[str]
) -> Posterior:
    """The same with what its scene and its readings give to think.

    Args:
        posterior: of the scene.
        spec: the scene.
        history: its readings.
        notes: further ones.
    """
    impulse = posterior.impulse_scale
    noise = (
        np.asarray(posterior.noise_scale, float),
        np.asarray(posterior.prior_noise_scale, float),
        None if impulse is None else np.asarray(impulse, float),
    )
    reasons = [
        *run_break_reasons(spec, history),
        *velocity_reasons(spec, history),
        *angle_sense_reasons(spec, history),
        *known_joint_reasons(spec, history),
        *end_stop_reasons(spec, history, posterior),
        *noise_reasons(spec, history, *noise),
        *density_reasons(spec, posterior),
        *lever_reasons(spec, posterior),
        *angle_reasons(spec, history, posterior),
        *stance_reasons(spec, posterior),
        *drag_reasons(spec, history, posterior),
        *still_reasons(spec, history, posterior),
    ]
    if reasons:
        posterior = with_diagnostics(posterior, reasons)
    left_out = posterior.diagnostics.get("notes", [])
    still = still_notes(spec, history, left_out)
    jitter = pose_velocity_notes(spec, history)
    notes = [*unread_notes(spec, history), *still, *jitter, *notes]
    return with_notes(posterior, notes)
