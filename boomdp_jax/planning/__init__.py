"""Search over any state: what to do now, given a model, a reward and a belief."""

from boomdp_jax.planning.a_star import PathReport as PathReport
from boomdp_jax.planning.a_star import a_star as a_star
from boomdp_jax.planning.belief import Belief as Belief
from boomdp_jax.planning.belief import certain as certain
from boomdp_jax.planning.forward_search import (
    ForwardSearchReport as ForwardSearchReport,
)
from boomdp_jax.planning.forward_search import (
    forward_search_sparse_sampling as forward_search_sparse_sampling,
)
from boomdp_jax.planning.plan import Plan as Plan
from boomdp_jax.planning.plan import SearchInfo as SearchInfo

__all__ = [
    "Belief",
    "ForwardSearchReport",
    "PathReport",
    "Plan",
    "SearchInfo",
    "a_star",
    "certain",
    "forward_search_sparse_sampling",
]
