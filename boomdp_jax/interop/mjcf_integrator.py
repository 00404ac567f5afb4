"""Which of MuJoCo's integrators a document names."""

from typing import Literal

import numpy as np

from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene_spec import SceneSpec

Integrator = Literal["implicitfast", "implicit", "Euler", "RK4"]

# Rate at which wheels slow a body down, over that of time steps, up to which Runge and
# Kutta's method follows them well; it is stable up to 2.8.
_MOST_RATE = 1.0


def usual_integrator(spec: SceneSpec, params: Params, time_step: float) -> Integrator:
    """One that follows a hypothesis and that MJX has as well.

    Args:
        spec: the scene.
        params: one hypothesis, of NumPy arrays.
        time_step: MuJoCo's own [s].
    """
    wheel = params.wheel
    if not np.any(wheel.active):
        return "implicitfast"
    mass = params.density * np.array([body.area for body in spec.bodies])
    # At least the rate [1/s] at which all wheels of a body slow it down together.
    gyration = np.asarray(spec.scene.gyration)[:, None]
    reach = 1.0 + np.sum(wheel.position**2, axis=-1) / gyration
    drag = np.where(wheel.active, np.sum(wheel.viscous, axis=-1) * reach, 0.0)
    is_soft = np.sum(drag, axis=-1) * time_step <= _MOST_RATE * mass
    return "RK4" if np.all(is_soft) else "implicitfast"
