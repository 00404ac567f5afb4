"""Bridges to other software; each loads it at first use."""

from boomdp_jax.interop.arviz import to_arviz as to_arviz
from boomdp_jax.interop.mjcf import RecordingLaws as RecordingLaws
from boomdp_jax.interop.mjcf_export import save_mjcf as save_mjcf
from boomdp_jax.interop.mjcf_export import to_mjcf as to_mjcf
from boomdp_jax.interop.mjcf_import import from_mjcf as from_mjcf
from boomdp_jax.interop.mjx import brax_randomisation as brax_randomisation
from boomdp_jax.interop.mjx import randomise_mjx as randomise_mjx
from boomdp_jax.interop.object_families import FAMILIES as FAMILIES
from boomdp_jax.interop.object_families import hide as hide
from boomdp_jax.interop.object_families import random_object as random_object
from boomdp_jax.interop.object_families import random_pushes as random_pushes
from boomdp_jax.interop.object_families import (
    record_random_pushes as record_random_pushes,
)
from boomdp_jax.interop.ray_sweep import sweep_with_ray as sweep_with_ray
from boomdp_jax.interop.recording import READING_NOISE as READING_NOISE
from boomdp_jax.interop.recording import record as record
from boomdp_jax.interop.recording import with_reading_noise as with_reading_noise

__all__ = [
    "FAMILIES",
    "READING_NOISE",
    "RecordingLaws",
    "brax_randomisation",
    "from_mjcf",
    "hide",
    "random_object",
    "random_pushes",
    "randomise_mjx",
    "record",
    "record_random_pushes",
    "save_mjcf",
    "sweep_with_ray",
    "to_arviz",
    "to_mjcf",
    "with_reading_noise",
]
