"""Noise that was inferred and is far more than readings scatter by.

What a model cannot follow it takes for noise: of a pin that the scene has a centimetre
from where it is, readings of a millimetre come out as errors of seven. How far each
reading is from the line through its neighbours bounds their noise from above, without
any model.
"""

import numpy as np
from jaxtyping import Float

from boomdp_jax.core.history import History
from boomdp_jax.inference.readings.reading_sequence import readings_in_order, scatter
from boomdp_jax.physics.scene_spec import SceneSpec

# How many times as much as readings scatter by, and as noise is a priori, which is all
# that is said of bodies whose readings were left out.
_TIMES, _TIMES_PRIOR = 3.0, 1.5
_MOST_SIZES = 10.0
_MOST_TURNED = 0.5
"""Chance of a step's turn that leaves next to nothing of an angle [rad]."""
_GROUPS = (
    ("position", (0, 1), "m"),
    ("angle", (2,), "rad"),
    ("velocity", (3, 4), "m/s"),
    ("spin", (5,), "rad/s"),
)


def noise_reasons(
    spec: SceneSpec,
    history: History,
    noise_scale: Float[np.ndarray, "draw body 4"],
    prior_noise_scale: Float[np.ndarray, "prior_draw body 4"],
    impulse_scale: Float[np.ndarray, "draw body 2"] | None,
) -> list[str]:
    """Reasons for doubt where readings or motion are taken to be too noisy.

    Args:
        spec: the scene, for names.
        history: its readings.
        noise_scale: draws of the posterior.
        prior_noise_scale: draws of the prior.
        impulse_scale: noise of the motion, draws of the posterior; None: there is none.

    Returns:
        One line for each body and group of channels, and where a body is taken to be
        off or to go by chance in one step by ten times its own size, or to turn by half
        a radian.
    """
    readings = readings_in_order(spec, history)
    inferred = np.median(noise_scale, axis=0)
    prior = np.median(prior_noise_scale, axis=0)
    reasons = []
    rows = np.asarray(history.mask)
    step = float(np.median(np.asarray(history.dt)[rows])) if np.any(rows) else 0.0
    kick = np.zeros((spec.num_bodies, 2))
    if impulse_scale is not None:
        kick = step * np.median(impulse_scale, axis=0)
    for body in np.flatnonzero(~np.asarray(spec.is_static)):
        for group, (name, channels, unit) in enumerate(_GROUPS):
            values = readings.values[:, body, list(channels)]
            bound = scatter(values, readings.run, is_angle=name == "angle")
            found = float(inferred[body, group])
            if bound is None:
                continue
            if found > max(_TIMES * bound, _TIMES_PRIOR * float(prior[body, group])):
                reasons.append(
                    f"{spec.names[body]}: readings of its {name} are taken to be off "
                    f"by {found:.2g} {unit}, though they scatter by {bound:.2g} "
                    f"{unit} at most: its motion is not the model's; expected what "
                    "the scene knows, units and axes to be as the recording has them"
                )
        shape = spec.bodies[body]
        corners = np.linalg.norm(shape.outline, axis=1)
        reach = float(np.max(corners, initial=0.0)) + shape.radius
        far = max(kick[body, 0], inferred[body, 0])
        for size, most, name, unit in (
            (far, _MOST_SIZES * reach, "position", "m"),
            (kick[body, 1], _MOST_TURNED, "angle", "rad"),
        ):
            if size > most:
                reasons.append(
                    f"{spec.names[body]}: its {name} is taken to be off or to change "
                    f"by chance by {size:.2g} {unit} in a step, more than {most:.2g} "
                    f"{unit}: expected metres, radians and seconds"
                )
    return reasons
