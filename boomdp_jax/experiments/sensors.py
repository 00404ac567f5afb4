"""What an agent is told of its sensors: how much they err, as on a data sheet.

Noise is inferred with everything else, from a prior around a millimetre and a
milliradian. Of sensors forty times worse that is the wrong thing to say: after one push
it left a pin that no noise was needed for, at 99 %, where there was a wheel.
"""

import dataclasses

import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.inference.hypotheses.prior import DEFAULT_NOISE, NOISE_GROUPS
from boomdp_jax.physics.scene_spec import SceneSpec


def with_sensors(spec: SceneSpec, reading_noise: Float[Array, "4"] | None) -> SceneSpec:
    """A scene whose prior knows how noisy readings are.

    Args:
        spec: the scene.
        reading_noise: standard deviation of readings of position [m], angle [rad],
            velocity [m/s] and spin [rad/s]; where it is below the default prior's
            scale, that one stays.

    Returns:
        The scene; the same one, if nothing is told.
    """
    if reading_noise is None:
        return spec
    told = dict(zip(NOISE_GROUPS, np.asarray(reading_noise).tolist(), strict=True))
    noise = {name: max(told[name], DEFAULT_NOISE[name]) for name in NOISE_GROUPS}
    return dataclasses.replace(spec, prior={**spec.prior, "noise": noise})
