"""What users give to the engine, checked before anything is compiled."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.checked_input import check_real, has_shape
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State


def check_world(scene: Any, params: Any) -> None:
    """Refuse what is no scene and no hypothesis about it, or many of them.

    Args:
        scene: what was given.
        params: what was given.

    Raises:
        TypeError: no `Scene`, or no `Params`.
        ValueError: a batch of either, or params of another number of bodies.
    """
    if not isinstance(scene, Scene):
        has_one = isinstance(getattr(scene, "scene", None), Scene)
        hint = "; its .scene is one" if has_one else ""
        raise TypeError(f"scene: expected a Scene, got {type(scene).__name__}{hint}")
    if not isinstance(params, Params):
        raise TypeError(f"params: expected Params, got {type(params).__name__}")
    if jnp.ndim(scene.area) != 1:
        raise ValueError(
            f"scene: expected one, got a batch of shape {jnp.shape(scene.area)[:-1]}; "
            "jax.vmap goes over a batch"
        )
    num = scene.num_bodies
    for name, array, num_axes in (
        ("density", params.density, 1),
        ("wheel.active", params.wheel.active, 2),
        ("ground.active", params.ground.active, 2),
    ):
        shape = jnp.shape(array)
        if len(shape) == num_axes and shape[0] == num:
            continue
        many = len(shape) > num_axes and shape[-num_axes] == num
        hint = "; jax.vmap goes over a batch of hypotheses" if many else ""
        expected = f"({num}, slots)" if num_axes == 2 else f"({num},)"
        raise ValueError(
            f"params.{name}: expected shape {expected} in a scene of {num} "
            f"bod{'y' if num == 1 else 'ies'}, got {shape}{hint}"
        )
    for name in ("revolute", "distance", "prismatic", "weld"):
        slots = getattr(params, name)
        if slots is not None and jnp.ndim(slots.active) != 1:
            raise ValueError(
                f"params.{name}.active: expected shape (slots,), got "
                f"{jnp.shape(slots.active)}; jax.vmap goes over a batch of hypotheses"
            )


def checked_state(num_bodies: int, state: Any, name: str = "state") -> State:
    """One state of so many bodies, in floats.

    Args:
        num_bodies: of the scene.
        state: what was given; whole numbers become floats.
        name: of the argument.

    Returns:
        The state.

    Raises:
        TypeError: no `State`.
        ValueError: of another number of bodies or of a batch, or no real numbers.
    """
    if not isinstance(state, State):
        raise TypeError(
            f"{name}: expected a State, got {type(state).__name__}; state_from_array "
            "makes one of an array [body, 6]"
        )
    pose, twist = (
        _rows(f"{name}.{field}", getattr(state, field), (num_bodies, 3))
        for field in ("pose", "twist")
    )
    return State(pose, twist)


def checked_wrench(
    num_bodies: int, wrench: Any, name: str = "wrench"
) -> Float[Array, "body 3"]:
    """A wrench on each of so many bodies, in floats.

    Args:
        num_bodies: of the scene.
        wrench: what was given; whole numbers become floats.
        name: of the argument.

    Returns:
        It, as an array.

    Raises:
        ValueError: another shape, or no real numbers.
    """
    return _rows(name, wrench, (num_bodies, 3))


def checked_wrenches(
    num_bodies: int, wrenches: Any, name: str = "wrenches"
) -> Float[Array, "time body 3"]:
    """The same for each step of a rollout.

    Args:
        num_bodies: of the scene.
        wrenches: what was given.
        name: of the argument.

    Returns:
        They, as an array.

    Raises:
        ValueError: another shape, or no real numbers.
    """
    return _rows(name, wrenches, ("time", num_bodies, 3))


def checked_length(dt: Any, num_steps: int, dtype: Any) -> Array:
    """Length of a step, or of each.

    Args:
        dt: what was given.
        num_steps: how many there are.
        dtype: of the result.

    Returns:
        A scalar or `[time]`.

    Raises:
        ValueError: of another shape, or a length known to be below zero.
    """
    length = jnp.asarray(dt, dtype)
    if length.shape not in ((), (num_steps,)):
        raise ValueError(
            f"dt: expected one number, or one for each of {num_steps} steps; got shape "
            f"{length.shape}"
        )
    _check_not_negative(dt)
    return length


def checked_step_length(dt: Any, dtype: Any) -> Array:
    """Length of one step.

    Args:
        dt: what was given.
        dtype: of the result.

    Raises:
        ValueError: no single number, or one known to be below zero.
    """
    length = jnp.asarray(dt, dtype)
    if length.shape != ():
        raise ValueError(f"dt: expected one number; got shape {length.shape}")
    _check_not_negative(dt)
    return length


def _check_not_negative(dt: Any) -> None:
    # Time does not run back: what rubs would drive.
    if not isinstance(dt, jax.core.Tracer) and np.any(np.asarray(dt) < 0):
        raise ValueError(f"dt: expected at least 0 s; got {np.min(np.asarray(dt))}")


def check_state_is_finite(state: State, names: Sequence[str]) -> None:
    """Make sure that it is known where every body is, as far as numbers are known yet.

    Args:
        state: of the bodies of a scene.
        names: of the bodies.

    Raises:
        ValueError: a number is not finite; of which body.
    """
    parts = (state.pose, state.twist)
    if any(isinstance(part, jax.core.Tracer) for part in parts):
        return
    rows = np.concatenate([np.asarray(part) for part in parts], axis=-1)
    wrong = np.flatnonzero(~np.all(np.isfinite(rows), axis=-1))
    if len(wrong):
        raise ValueError(
            f"state: body {names[wrong[0]]!r}: expected finite numbers, got "
            f"{rows[wrong[0]].tolist()}"
        )


def _rows(name: str, rows: Any, shape: tuple) -> Array:
    """Three numbers of each body; a word in `shape` is an axis of any length."""
    array = rows if isinstance(rows, jax.Array) else np.asarray(rows)
    check_real(name, array.dtype)
    if not has_shape(array.shape, shape):
        wanted = ", ".join(map(str, shape))
        raise ValueError(
            f"{name}: expected shape ({wanted}), one row for each body of the scene, "
            f"got {array.shape}"
        )
    if isinstance(array, jax.Array) and jnp.issubdtype(array.dtype, jnp.floating):
        return array
    return jnp.asarray(array, float)
