"""A posterior as ArviZ sees it, with dimensions named by body, joint and wheel."""

import importlib
import warnings
from typing import Any

import jax
import numpy as np

from boomdp_jax.inference.hypotheses.body_numbers import get_number
from boomdp_jax.inference.hypotheses.layout import BODY_NUMBERS
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.inference.posteriors.summary import CHANNELS
from boomdp_jax.physics.constraint_spec import JOINTS, KINDS
from boomdp_jax.physics.params import Params

_SUFFIX_DIMS = {
    "anchor_a": ("axis",),
    "anchor_b": ("axis",),
    "position": ("axis",),
    "load_shift": ("axis",),
    "stance_scale": ("axis",),
    "wheel_viscous": ("direction",),
    "wheel_dry": ("direction",),
}

_BODY_DIMS = {"center_of_mass": ("axis",), "actuator.bias": ("wrench",)}


def to_arviz(posterior: Posterior) -> Any:
    """Convert a posterior to `arviz.InferenceData`, or a `DataTree` in ArviZ 1.

    Chains become a dimension where they are equally long and draws equally weighted;
    otherwise the draws are resampled to equal weights and form one chain. Numbers of a
    constraint that a draw does not have are NaN.

    Args:
        posterior: what is known.

    Returns:
        Groups `posterior` (numbers of Φ, mass, noise), `sample_stats` (log-density,
        chain of origin) and `prior`.

    Raises:
        ImportError: ArviZ is not installed.
    """
    try:
        with warnings.catch_warnings():
            # ArviZ 0.23 announces its next version once a day when it is imported.
            warnings.simplefilter("ignore", FutureWarning)
            arviz: Any = importlib.import_module("arviz")
    except ImportError as error:
        raise ImportError(
            "ArviZ is not installed; pip install 'boomdp_jax[arviz]'"
        ) from error
    kept = posterior.thin(posterior.num_draws)
    num_chains = _num_chains(np.asarray(kept.chain))
    if kept is not posterior:
        num_chains = 1

    def split(array: np.ndarray) -> np.ndarray:
        return array.reshape(num_chains, -1, *array.shape[1:])

    noise = {"noise_scale": kept.noise_scale, "impulse_scale": kept.impulse_scale}
    numbers, dims = _variables(posterior, kept.params, noise)
    prior_noise = {
        "noise_scale": kept.prior_noise_scale,
        "impulse_scale": kept.prior_impulse_scale,
    }
    prior, _ = _variables(posterior, kept.prior_params, prior_noise)
    groups = {
        "posterior": {name: split(array) for name, array in numbers.items()},
        "sample_stats": {
            "lp": split(np.asarray(kept.log_density)),
            "chain_of_origin": split(np.asarray(kept.chain)),
        },
        "prior": {name: array[None] for name, array in prior.items()},
    }
    coords = _coordinates(posterior)
    major = int(arviz.__version__.split(".")[0])
    if major >= 1:
        return arviz.from_dict(groups, coords=coords, dims=dims)
    return arviz.from_dict(**groups, coords=coords, dims=dims)


def _num_chains(chain: np.ndarray) -> int:
    """Chains that lie one after the other and are equally long; else one."""
    names, counts = np.unique(chain, return_counts=True)
    ordered = np.repeat(names, counts[0])
    if np.ptp(counts) == 0 and np.array_equal(chain, ordered):
        return len(names)
    return 1


def _variables(
    posterior: Posterior, params: Params, noise: dict
) -> tuple[dict[str, np.ndarray], dict[str, list[str]]]:
    """Arrays by name, leading axis draw, and the names of their other axes."""
    params = jax.tree.map(np.asarray, params)
    area = np.array([body.area for body in posterior.spec.bodies])
    numbers = {
        "density": params.density,
        "mass": params.density * area,
        **{k: np.asarray(v) for k, v in noise.items() if v is not None},
    }
    dims = {
        "density": ["body"],
        "mass": ["body"],
        "noise_scale": ["body", "channel"],
    }
    for key in BODY_NUMBERS:
        value = get_number(params, key)
        if value is not None:
            name = key.replace(".", "_")
            numbers[name] = value
            dims[name] = ["body", *_BODY_DIMS.get(key, ())]
    if "impulse_scale" in numbers:
        dims["impulse_scale"] = ["body", "impulse"]
    if params.surface is not None:
        for field, array in vars(params.surface).items():
            name = f"contact_{field}"
            numbers[name], dims[name] = array, ["body"]
    slot_dims = {
        **{kind: [kind] for kind in JOINTS},
        "wheel": ["body", "wheel"],
        "ground": ["body", "ground"],
    }
    for kind, axes in slot_dims.items():
        group = getattr(params, kind)
        if group is None or group.active.shape[-1] == 0:
            continue
        for field, array in vars(group).items():
            if array is None:
                continue
            name = f"{kind}_{field}"
            extra = _SUFFIX_DIMS.get(name, _SUFFIX_DIMS.get(field, ()))
            dims[name] = [*axes, *extra]
            numbers[name] = array
            if array.dtype.kind == "f":
                active = group.active.reshape(
                    *group.active.shape, *[1] * (array.ndim - group.active.ndim)
                )
                numbers[name] = np.where(active, array, np.nan)
    return numbers, dims


def _coordinates(posterior: Posterior) -> dict[str, list]:
    """Names along each axis."""
    params = posterior.params
    return {
        "body": list(posterior.spec.names),
        "channel": list(CHANNELS),
        "impulse": ["velocity", "spin"],
        "axis": ["x", "y"],
        "wrench": ["force_x", "force_y", "torque"],
        "direction": ["rolling", "lateral"],
        **{
            kind: list(range(getattr(params, kind).active.shape[-1]))
            for kind in KINDS
            if getattr(params, kind) is not None
        },
    }
