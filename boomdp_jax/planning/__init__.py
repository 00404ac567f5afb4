"""Search over any state: what to do now, given a model, a reward and a belief."""

from boomdp_jax.planning.belief import Belief as Belief
from boomdp_jax.planning.belief import certain as certain
from boomdp_jax.planning.plan import Plan as Plan
from boomdp_jax.planning.plan import SearchInfo as SearchInfo
from boomdp_jax.planning.sparse_sampling import sparse_sampling as sparse_sampling

__all__ = ["Belief", "Plan", "SearchInfo", "certain", "sparse_sampling"]
