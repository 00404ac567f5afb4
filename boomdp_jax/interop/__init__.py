"""Bridges to other software; each loads it at first use."""

from boomdp_jax.interop.arviz import to_arviz as to_arviz
from boomdp_jax.interop.brax_env import BraxTask as BraxTask
from boomdp_jax.interop.brax_env import register_brax_envs as register_brax_envs
from boomdp_jax.interop.brax_posterior import task_randomisation as task_randomisation
from boomdp_jax.interop.brax_training import TrainedPolicy as TrainedPolicy
from boomdp_jax.interop.brax_training import train_ppo as train_ppo
from boomdp_jax.interop.continuous_actions import ContinuousActions as ContinuousActions
from boomdp_jax.interop.continuous_actions import (
    continuous_actions as continuous_actions,
)
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
from boomdp_jax.interop.ompl_motion import plan_motion as plan_motion
from boomdp_jax.interop.ray_sweep import sweep_with_ray as sweep_with_ray
from boomdp_jax.interop.recording import READING_NOISE as READING_NOISE
from boomdp_jax.interop.recording import record as record
from boomdp_jax.interop.recording import with_reading_noise as with_reading_noise

__all__ = [
    "FAMILIES",
    "READING_NOISE",
    "BraxTask",
    "ContinuousActions",
    "RecordingLaws",
    "TrainedPolicy",
    "brax_randomisation",
    "continuous_actions",
    "from_mjcf",
    "hide",
    "plan_motion",
    "random_object",
    "random_pushes",
    "randomise_mjx",
    "record",
    "record_random_pushes",
    "register_brax_envs",
    "save_mjcf",
    "sweep_with_ray",
    "task_randomisation",
    "to_arviz",
    "to_mjcf",
    "train_ppo",
    "with_reading_noise",
]
