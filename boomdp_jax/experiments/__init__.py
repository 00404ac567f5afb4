"""Experiments: many seeds of an agent on a task, written as they are done."""

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
    "TASKS",
    "Run",
    "Samples",
    "agent_of",
    "begin_run",
    "make_task",
    "taught",
    "unbiased_samples",
]
