"""Experiments: many seeds of an agent on a task, written as they are done."""

from boomdp_jax.experiments.namo import CHARACTERS as CHARACTERS
from boomdp_jax.experiments.namo import make_room as make_room
from boomdp_jax.experiments.namo import namo_episode as namo_episode
from boomdp_jax.experiments.namo_run import NamoRun as NamoRun
from boomdp_jax.experiments.namo_run import begin_namo as begin_namo
from boomdp_jax.experiments.registry import AGENTS as AGENTS
from boomdp_jax.experiments.registry import TASKS as TASKS
from boomdp_jax.experiments.registry import agent_of as agent_of
from boomdp_jax.experiments.registry import make_task as make_task
from boomdp_jax.experiments.run import Run as Run
from boomdp_jax.experiments.run import begin_run as begin_run
from boomdp_jax.experiments.teaching import Samples as Samples
from boomdp_jax.experiments.teaching import taught as taught
from boomdp_jax.experiments.teaching import unbiased_samples as unbiased_samples

__all__ = [
    "AGENTS",
    "CHARACTERS",
    "TASKS",
    "NamoRun",
    "Run",
    "Samples",
    "agent_of",
    "begin_namo",
    "begin_run",
    "make_room",
    "make_task",
    "namo_episode",
    "taught",
    "unbiased_samples",
]
