"""What users give to `infer`, checked before anything is worked out."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from boomdp_jax.core.history import History
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
    is_key = isinstance(key, jax.Array) and (
        jnp.issubdtype(key.dtype, jax.dtypes.prng_key) or key.dtype == jnp.uint32
    )
    if not is_key:
        raise TypeError(f"key: expected one such as jax.random.key(0); got {key!r}")
    if mesh is not None and not isinstance(mesh, Mesh):
        raise TypeError(f"mesh: expected a jax.sharding.Mesh; got {mesh!r}")
    for name, values in (("specs", specs), ("histories", histories)):
        if isinstance(values, str) or not isinstance(values, Sequence):
            raise TypeError(f"{name}: expected a list; got {_kind(values)}")
    if len(specs) != len(histories):
        raise ValueError(
            f"histories: expected one per scene, {len(specs)}, got {len(histories)}"
        )
    for spec, history in zip(specs, histories, strict=True):
        if not isinstance(spec, SceneSpec):
            raise TypeError(
                "spec: expected a SceneSpec, as load_scene and scene_spec_from_dict "
                f"return; got {_kind(spec)}"
            )
        check_history(spec, history)


def check_history(spec: SceneSpec, history: Any) -> None:
    """Raise unless a history is about a scene that can be inferred.

    Args:
        spec: the scene.
        history: what was given.

    Raises:
        TypeError: no `History`.
        ValueError: one with a batch axis, or of another number of bodies.
    """
    if not isinstance(history, History):
        raise TypeError(
            "history: expected a History, as load_history and make_history return; "
            f"got {_kind(history)}"
        )
    if history.state.ndim != 3:
        raise ValueError(
            f"{spec.source}: history: expected states [time, body, 6]; got shape "
            f"{history.state.shape}"
        )
    if history.num_bodies != spec.num_bodies:
        raise ValueError(
            f"{spec.source}: history: expected {spec.num_bodies} bodies, got "
            f"{history.num_bodies}"
        )


def _kind(value: Any) -> str:
    return "None" if value is None else type(value).__name__
