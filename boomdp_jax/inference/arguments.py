"""What users give to `infer`, checked before anything is worked out."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from boomdp_jax.core.history import History
from boomdp_jax.inference.members import naming
from boomdp_jax.physics.scene_spec import SceneSpec


def check_arguments(key: Any, specs: Any, histories: Any, mesh: Any) -> None:
    """Raise unless arguments of `infer_batch` are what they should be.

    Args:
        key: random key.
        specs: the scenes.
        histories: one for each.
        mesh: devices, or None.

    Raises:
        TypeError: one of another type.
        ValueError: a history with a batch axis, or of other bodies than its scene's.
    """
    check_key(key)
    if mesh is not None and not isinstance(mesh, Mesh):
        raise TypeError(f"mesh: expected a jax.sharding.Mesh; got {mesh!r}")
    for name, values in (("specs", specs), ("histories", histories)):
        if isinstance(values, str) or not isinstance(values, Sequence):
            raise TypeError(f"{name}: expected a list; got {kind_of(values)}")
    if len(specs) != len(histories):
        raise ValueError(
            f"histories: expected one per scene, {len(specs)}, got {len(histories)}"
        )
    for index, (spec, history) in enumerate(zip(specs, histories, strict=True)):
        with naming(index, len(specs)):
            check_spec(spec)
            check_history(spec, history)


def check_key(key: Any) -> None:
    """Raise a TypeError unless something is a random key."""
    is_key = isinstance(key, jax.Array) and (
        jnp.issubdtype(key.dtype, jax.dtypes.prng_key) or key.dtype == jnp.uint32
    )
    if not is_key:
        raise TypeError(f"key: expected one such as jax.random.key(0); got {key!r}")


def check_spec(spec: Any, name: str = "spec") -> None:
    """Raise a TypeError unless something is a scene; the name is for the message."""
    if not isinstance(spec, SceneSpec):
        raise TypeError(
            f"{name}: expected a SceneSpec, as load_scene and scene_spec_from_dict "
            f"return; got {kind_of(spec)}"
        )


def check_history(spec: SceneSpec, history: Any, name: str = "history") -> None:
    """Raise unless a history is about a scene that can be inferred.

    Args:
        spec: the scene.
        history: what was given.
        name: of the argument, for the message.

    Raises:
        TypeError: no `History`.
        ValueError: one with a batch axis, or of another number of bodies.
    """
    if not isinstance(history, History):
        raise TypeError(
            f"{name}: expected a History, as load_history and make_history return; "
            f"got {kind_of(history)}"
        )
    if history.state.ndim != 3:
        raise ValueError(
            f"{spec.source}: {name}: expected states [time, body, 6]; got shape "
            f"{history.state.shape}"
        )
    if history.num_bodies != spec.num_bodies:
        raise ValueError(
            f"{spec.source}: {name}: expected {spec.num_bodies} bodies, got "
            f"{history.num_bodies}"
        )


def kind_of(value: Any) -> str:
    """Name of the type of something, for a message."""
    return "None" if value is None else type(value).__name__
