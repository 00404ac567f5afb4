"""Agents: a model, a planner and exploration, closed around a task."""

from boomdp_jax.agents.agent import Agent as Agent
from boomdp_jax.agents.agent import make_agent as make_agent
from boomdp_jax.agents.agent import random_agent as random_agent
from boomdp_jax.agents.compiled_episode import can_compile as can_compile
from boomdp_jax.agents.compiled_episode import compile_episode as compile_episode
from boomdp_jax.agents.curiosity import curious as curious
from boomdp_jax.agents.curiosity import curious_of_pieces as curious_of_pieces
from boomdp_jax.agents.episode import EpisodeRecord as EpisodeRecord
from boomdp_jax.agents.episode import run_episode as run_episode
from boomdp_jax.agents.namo_agent import Character as Character
from boomdp_jax.agents.namo_agent import NamoPlanner as NamoPlanner
from boomdp_jax.agents.namo_episode import NamoRecord as NamoRecord
from boomdp_jax.agents.namo_episode import run_namo as run_namo
from boomdp_jax.agents.path_agent import make_path_agent as make_path_agent
from boomdp_jax.agents.piecewise_agent import (
    make_piecewise_agent as make_piecewise_agent,
)
from boomdp_jax.agents.restlessness import restless as restless

__all__ = [
    "Agent",
    "Character",
    "EpisodeRecord",
    "NamoPlanner",
    "NamoRecord",
    "can_compile",
    "compile_episode",
    "curious",
    "curious_of_pieces",
    "make_agent",
    "make_path_agent",
    "make_piecewise_agent",
    "random_agent",
    "restless",
    "run_episode",
    "run_namo",
]
