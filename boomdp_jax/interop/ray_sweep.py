"""Sweeps on a Ray cluster: every unit is a task, taken by whoever is free.

Prefer it to shards where units take very different times or machines come and go;
shards (`infer_sweep(shard=)`) need nothing but a common folder. A unit computes the
same bits wherever it runs, so all of them can be mixed, and resumed.
"""

import dataclasses
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.history import History
from boomdp_jax.inference.sweeps.sweep import Sweep
from boomdp_jax.physics.scene_spec import scene_spec_from_dict


def sweep_with_ray(
    sweep: Sweep,
    *,
    num_cpus: int | float = 1,
    num_gpus: int | float = 0,
    max_retries: int = 3,
    on_done: Callable[[int], object] = lambda unit: None,
) -> list[Path]:
    """Run all units of a sweep that are not done as Ray tasks, and wait for them.

    Ray is started on this machine if it is not connected to a cluster. The sweep's
    folder, and recordings given as files, must be reachable from all machines under the
    same names.

    Args:
        sweep: of `begin_sweep`.
        num_cpus: cores that one unit takes.
        num_gpus: accelerators that one unit takes.
        max_retries: how often a unit whose worker dies is begun again.
        on_done: called with the number of each unit when its files are there, in the
            order in which they finish.

    Returns:
        The files of all objects, in order.

    Raises:
        ImportError: Ray is not installed.
        ValueError: a unit was made from other recordings or scenes; or, from a worker,
            other versions there than the folder was begun with. A `SweepError`, once
            all else is done: inference refused some of the objects.
    """
    try:
        # Looked up by name, since it is an extra.
        ray: Any = importlib.import_module("ray")
    except ImportError as error:
        raise ImportError(
            "sweep_with_ray: expected Ray, got none; pip install 'boomdp_jax[ray]'"
        ) from error
    if not ray.is_initialized():
        ray.init()
    options = {"num_cpus": num_cpus, "num_gpus": num_gpus, "max_retries": max_retries}
    task = ray.remote(**options)(_run_unit)
    is_double = bool(jax.dtypes.canonicalize_dtype(float) == np.float64)
    shared = ray.put(_pack(sweep))
    waiting = {}
    units = sweep.units()
    # Other recordings than the folder's are refused before the work begins.
    is_done = [sweep.is_done(unit) for unit in units]
    for unit in units:
        if is_done[unit]:
            on_done(unit)
        else:
            waiting[task.remote(shared, unit, is_double)] = unit
    while waiting:
        (first, *_), _ = ray.wait(list(waiting), num_returns=1)
        # Raises what the task raised.
        ray.get(first)
        on_done(waiting.pop(first))
    return sweep.finish(units)


class _Parcel(NamedTuple):
    """A sweep without arrays of JAX, which lose their float type on the way."""

    bare: Sweep
    """Without scenes and recordings."""
    scenes: list[tuple[dict, str]]
    """Contents and sources of the different ones."""
    places: list[int]
    """Which of them belongs to each recording."""
    recordings: list[Path | dict[str, np.ndarray]]


def _pack(sweep: Sweep) -> _Parcel:
    """Files get names that hold in every working directory."""
    different = {id(spec): spec for spec in sweep.specs}
    order = list(different)
    recordings: list[Path | dict[str, np.ndarray]] = []
    for source in sweep.histories:
        if isinstance(source, History):
            names = [field.name for field in dataclasses.fields(source)]
            recordings.append({n: np.asarray(getattr(source, n)) for n in names})
        else:
            recordings.append(Path(source).absolute())
    return _Parcel(
        bare=dataclasses.replace(
            sweep, folder=sweep.folder.absolute(), specs=(), histories=()
        ),
        scenes=[(spec.to_dict(), spec.source) for spec in different.values()],
        places=[order.index(id(spec)) for spec in sweep.specs],
        recordings=recordings,
    )


def _unpack(parcel: _Parcel) -> Sweep:
    specs = [scene_spec_from_dict(*scene) for scene in parcel.scenes]
    return dataclasses.replace(
        parcel.bare,
        specs=tuple(specs[place] for place in parcel.places),
        histories=tuple(
            source
            if isinstance(source, Path)
            else History(**{k: on_device(v, v.dtype) for k, v in source.items()})
            for source in parcel.recordings
        ),
    )


def _run_unit(parcel: _Parcel, unit: int, is_double: bool) -> None:
    """What a worker does: with the float type of whom it works for."""
    with jax.enable_x64(is_double):
        sweep = _unpack(parcel)
        sweep.check_folder()
        sweep.run(unit)
