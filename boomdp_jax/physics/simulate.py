r"""Trajectories with noise: random shakes of what moves, random errors of readings.

The generative model that inference inverts: with f the step, Q and R diagonal,

$$s_{t+1} = f(s_t + (0, q_t), u_t), \quad q_t \sim N(0, Q), \qquad
  o_t = s_t + r_t, \quad r_t \sim N(0, R).$$

Process noise is a change of twist *before* the step, so that joints take up what they
do not allow: a pinned body stays on its pin however hard it is shaken.
"""

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import FloatScalar, Key
from boomdp_jax.physics.arguments import (
    checked_length,
    checked_state,
    checked_wrenches,
)
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State, state_from_array
from boomdp_jax.physics.step import StepInfo, prepare_step, step
from boomdp_jax.physics.world_rollout import empty_cache

_CHANNEL_GROUP = np.array([0, 0, 1, 2, 2, 3], np.int32)
"""Group of each channel of a state: position, angle, velocity, spin."""


class SimulationNoise(eqx.Module):
    """How much of the motion and of its readings is left to chance."""

    process: Float[Array, "*body 3"]
    """Standard deviation of the change of twist before each step, whatever its length
    [m/s, m/s, rad/s]; one row for all bodies or one for each."""
    observation: Float[Array, "4"]
    """Standard deviation of readings: position [m], angle [rad], velocity [m/s] and
    spin [rad/s]."""


def simulate(
    key: Key,
    scene: Scene,
    params: Params,
    state: State,
    wrenches: Float[Array, "time body 3"],
    noise: SimulationNoise,
    *,
    dt: Float[Array, " time"] | FloatScalar | float | None = None,
) -> tuple[State, State, StepInfo]:
    """Advance a world by many steps, shaken, and read it with errors.

    Without noise it is `rollout`. Static bodies are neither shaken nor misread.

    Args:
        key: randomness.
        scene: outlines, feet, gravity.
        params: one hypothesis.
        state: where it starts.
        wrenches: one per step and body, world frame [N, N, N m].
        noise: scales of the noise.
        dt: length of the steps [s], one for all or one for each; default: the scene's.

    Returns:
        The true states after each step, their readings, and the reports of the steps,
        all with a leading time axis.

    Raises:
        TypeError: a state that is none.
        ValueError: a state, wrenches, lengths or noise of another shape; noise below
            zero, where it is known yet.
    """
    state = checked_state(scene.num_bodies, state)
    wrenches = checked_wrenches(scene.num_bodies, wrenches)
    num_bodies = scene.num_bodies
    _check_noise(noise, num_bodies)
    process_key, observation_key = jax.random.split(key)
    moves = 1.0 - scene.is_static.astype(state.pose.dtype)
    process = jnp.broadcast_to(noise.process, (num_bodies, 3)) * moves[:, None]
    shakes = jax.random.normal(process_key, wrenches.shape, state.twist.dtype)
    shakes = shakes * process[None]
    states, info = _advance_all(scene, params, state, wrenches, shakes, dt)
    errors = jax.random.normal(observation_key, states.array.shape, state.pose.dtype)
    scale = noise.observation[_CHANNEL_GROUP][None, :] * moves[:, None]
    return states, state_from_array(states.array + errors * scale[None]), info


def _check_noise(noise: SimulationNoise, num_bodies: int) -> None:
    if jnp.shape(noise.process) not in ((3,), (num_bodies, 3)):
        raise ValueError(
            f"Process noise has shape {jnp.shape(noise.process)}; give one row of 3 "
            f"for all bodies or one for each of the scene's {num_bodies}."
        )
    if jnp.shape(noise.observation) != (4,):
        raise ValueError(
            "noise.observation: expected shape (4,), of position, angle, velocity and "
            f"spin; got {jnp.shape(noise.observation)}"
        )
    for name in ("process", "observation"):
        scale = getattr(noise, name)
        if not isinstance(scale, jax.core.Tracer) and not np.all(
            np.asarray(scale) >= 0
        ):
            raise ValueError(
                f"noise.{name}: expected standard deviations of at least 0; got "
                f"{np.asarray(scale)}"
            )


def _advance_all(scene, params, state, wrenches, shakes, dt) -> tuple[State, StepInfo]:
    """Step by step, each with a change of twist before it."""
    length = checked_length(
        scene.dt if dt is None else dt, wrenches.shape[0], state.pose.dtype
    )
    is_constant = length.ndim == 0
    constant = None
    if scene.collides is None and is_constant:
        constant = prepare_step(scene, params, dt=length)

    def advance(carry, inputs):
        state, cache = carry
        wrench, shake, step_length = inputs
        shaken = State(pose=state.pose, twist=state.twist + shake)
        if constant is None:
            now = length if is_constant else step_length
            after, info = step(scene, params, shaken, wrench, dt=now, cache=cache)
        else:
            after, info = constant(shaken, wrench)
        # Carried, and not reported: for every step it would be most of the memory.
        report = eqx.tree_at(
            lambda i: i.cache, info, None, is_leaf=lambda leaf: leaf is None
        )
        return (after, info.cache), (after, report)

    inputs = (wrenches, shakes, None if is_constant else length)
    # A reverse pass takes every step again, rather than to store all of its parts.
    one_step = jax.checkpoint(advance, prevent_cse=False)
    return jax.lax.scan(one_step, (state, empty_cache(scene)), inputs)[1]
