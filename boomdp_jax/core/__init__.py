"""Array aliases, transitions, histories and their files."""

from boomdp_jax.core.action_file import ActionTable as ActionTable
from boomdp_jax.core.action_file import load_actions as load_actions
from boomdp_jax.core.applied_force import wrench_at_reference as wrench_at_reference
from boomdp_jax.core.atomic import atomic_file as atomic_file
from boomdp_jax.core.atomic import atomic_write as atomic_write
from boomdp_jax.core.history import History as History
from boomdp_jax.core.history import Transition as Transition
from boomdp_jax.core.history import make_history as make_history
from boomdp_jax.core.history_file import load_history as load_history
from boomdp_jax.core.history_file import load_transitions as load_transitions
from boomdp_jax.core.history_file import save_history as save_history
from boomdp_jax.core.history_file import save_transitions as save_transitions
from boomdp_jax.core.kept_programs import keep_programs as keep_programs
from boomdp_jax.core.transition_table import TransitionTable as TransitionTable

__all__ = [
    "ActionTable",
    "History",
    "Transition",
    "TransitionTable",
    "atomic_file",
    "atomic_write",
    "keep_programs",
    "load_actions",
    "load_history",
    "load_transitions",
    "make_history",
    "save_history",
    "save_transitions",
    "wrench_at_reference",
]
