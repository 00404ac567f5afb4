r"""Energy, momentum and joint drift of a state: what the laws of motion keep or not.

All are functions of one world; the caller adds `vmap` over time or hypotheses. Static
bodies are left out: whatever holds them takes up any momentum, and they do no work.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.physics.center_of_mass import state_of_center
from boomdp_jax.physics.joints import joints_of
from boomdp_jax.physics.motion import Motion
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State
from boomdp_jax.physics.step_info import joint_drift


def mass_and_inertia(
    scene: Scene, params: Params
) -> tuple[Float[Array, " body"], Float[Array, " body"]]:
    r"""Mass and rotational inertia of every body that moves.

    $m = d A$ and $I = m k^2$, with density d, area A and radius of gyration k.

    Args:
        scene: outlines.
        params: one hypothesis.

    Returns:
        Masses [kg] and inertias about the centres of mass [kg m²]; zero for a static
        body, so that it adds nothing to a sum.
    """
    mass = jnp.where(scene.is_static, 0.0, params.density * scene.area)
    return mass, mass * scene.gyration


def kinetic_energy(scene: Scene, params: Params, state: State) -> FloatScalar:
    r"""Energy of motion, $\sum_i (m_i |v_i|^2 + I_i \omega_i^2)/2$.

    Args:
        scene: outlines.
        params: one hypothesis.
        state: poses and twists.

    Returns:
        The energy [J].
    """
    state = state_of_center(params, state)
    mass, inertia = mass_and_inertia(scene, params)
    square = jnp.sum(state.twist[:, :2] ** 2, axis=-1)
    return 0.5 * jnp.sum(mass * square + inertia * state.twist[:, 2] ** 2)


@full_precision
def potential_energy(scene: Scene, params: Params, state: State) -> FloatScalar:
    r"""Energy in the in-plane gravity, $-\sum_i m_i \, g \cdot x_i$.

    Args:
        scene: outlines and gravity.
        params: one hypothesis.
        state: poses and twists.

    Returns:
        The energy [J], zero with all centres of mass at the origin of the world.
    """
    state = state_of_center(params, state)
    mass, _ = mass_and_inertia(scene, params)
    return -jnp.sum(mass * (state.pose[:, :2] @ scene.gravity))


def total_energy(scene: Scene, params: Params, state: State) -> FloatScalar:
    """Kinetic and potential energy; kept where nothing rubs, hits or pushes.

    Joints hold rigidly and store none.

    Args:
        scene: outlines and gravity.
        params: one hypothesis.
        state: poses and twists.

    Returns:
        The energy [J].
    """
    kinetic = kinetic_energy(scene, params, state)
    return kinetic + potential_energy(scene, params, state)


@full_precision
def linear_momentum(scene: Scene, params: Params, state: State) -> Float[Array, "2"]:
    r"""Momentum of all bodies together, $\sum_i m_i v_i$.

    Args:
        scene: outlines.
        params: one hypothesis.
        state: poses and twists.

    Returns:
        The momentum [kg m/s].
    """
    state = state_of_center(params, state)
    mass, _ = mass_and_inertia(scene, params)
    return mass @ state.twist[:, :2]


def angular_momentum(
    scene: Scene,
    params: Params,
    state: State,
    about: Float[Array, "2"] | tuple[FloatScalar | float, FloatScalar | float] = (
        0.0,
        0.0,
    ),
) -> FloatScalar:
    r"""Moment of momentum, $\sum_i I_i \omega_i + (x_i - o) \times m_i v_i$.

    Args:
        scene: outlines.
        params: one hypothesis.
        state: poses and twists.
        about: world point o [m].

    Returns:
        The angular momentum about that point [kg m²/s].
    """
    state = state_of_center(params, state)
    mass, inertia = mass_and_inertia(scene, params)
    arm_x, arm_y = state.pose[:, 0] - about[0], state.pose[:, 1] - about[1]
    vx, vy, spin = state.twist.T
    return jnp.sum(inertia * spin + mass * (arm_x * vy - arm_y * vx))


def constraint_error(scene: Scene, params: Params, state: State) -> FloatScalar:
    r"""Largest distance by which an active joint fails to hold.

    For a pin $|p_a - p_b|$, for a rod $\big| |p_a - p_b| - L \big|$, with p the anchors
    in the world. Wheels and floor friction constrain no pose.

    Args:
        scene: outlines; only how many bodies there are is read.
        params: one hypothesis.
        state: poses and twists.

    Returns:
        The distance [m]; zero where nothing is joined. Where an error is exactly zero,
        its derivative is taken to be zero.

    Raises:
        ValueError: the state has another number of bodies than the scene.
    """
    if state.pose.shape[0] != scene.num_bodies:
        raise ValueError(
            f"Scene has {scene.num_bodies} bodies but the state {state.pose.shape[0]}; "
            "give the state of this scene."
        )
    dtype = state.pose.dtype
    params, motion, gyration = jax.tree.map(
        lambda leaf: leaf[..., None],
        (params, Motion(*state.pose.T, *state.twist.T), scene.gyration),
    )
    return joint_drift(joints_of(params, dtype), motion, gyration)[0]
