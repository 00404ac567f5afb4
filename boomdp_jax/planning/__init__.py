"""Search over any state: what to do now, given a model, a reward and a belief."""

from boomdp_jax.planning.a_star import PathReport as PathReport
from boomdp_jax.planning.a_star import a_star as a_star
from boomdp_jax.planning.belief import Belief as Belief
from boomdp_jax.planning.belief import certain as certain
from boomdp_jax.planning.cross_entropy import (
    cross_entropy_method as cross_entropy_method,
)
from boomdp_jax.planning.forward_search import (
    ForwardSearchReport as ForwardSearchReport,
)
from boomdp_jax.planning.forward_search import (
    forward_search_sparse_sampling as forward_search_sparse_sampling,
)
from boomdp_jax.planning.gradient_shooting import gradient_shooting as gradient_shooting
from boomdp_jax.planning.leaf import rollout_leaf as rollout_leaf
from boomdp_jax.planning.learned_leaf import LearnedLeaf as LearnedLeaf
from boomdp_jax.planning.learned_leaf import learned_leaf as learned_leaf
from boomdp_jax.planning.mctx_search import mctx_search as mctx_search
from boomdp_jax.planning.motion import IsFree as IsFree
from boomdp_jax.planning.motion import PlanMotion as PlanMotion
from boomdp_jax.planning.motion import TimedMotion as TimedMotion
from boomdp_jax.planning.motion import edge_points as edge_points
from boomdp_jax.planning.motion import motion_length as motion_length
from boomdp_jax.planning.motion import motion_points as motion_points
from boomdp_jax.planning.motion import timed_motion as timed_motion
from boomdp_jax.planning.mppi import mppi as mppi
from boomdp_jax.planning.plan import Plan as Plan
from boomdp_jax.planning.plan import SearchInfo as SearchInfo
from boomdp_jax.planning.random_shooting import random_shooting as random_shooting
from boomdp_jax.planning.regions import Grid as Grid
from boomdp_jax.planning.regions import Ways as Ways
from boomdp_jax.planning.regions import grid_between as grid_between
from boomdp_jax.planning.regions import label_regions as label_regions
from boomdp_jax.planning.regions import ways_from as ways_from
from boomdp_jax.planning.sparse_sampling import sparse_sampling as sparse_sampling
from boomdp_jax.planning.tree_levels import TreeLevel as TreeLevel
from boomdp_jax.planning.tree_levels import tree_levels as tree_levels
from boomdp_jax.planning.trials import Trial as Trial
from boomdp_jax.planning.trials import best_order as best_order
from boomdp_jax.planning.trials import region_values as region_values
from boomdp_jax.planning.trials import worth_of_test as worth_of_test

__all__ = [
    "Belief",
    "ForwardSearchReport",
    "Grid",
    "IsFree",
    "LearnedLeaf",
    "PathReport",
    "Plan",
    "PlanMotion",
    "SearchInfo",
    "TimedMotion",
    "TreeLevel",
    "Trial",
    "Ways",
    "a_star",
    "best_order",
    "certain",
    "cross_entropy_method",
    "edge_points",
    "forward_search_sparse_sampling",
    "gradient_shooting",
    "grid_between",
    "label_regions",
    "learned_leaf",
    "mctx_search",
    "motion_length",
    "motion_points",
    "mppi",
    "random_shooting",
    "region_values",
    "rollout_leaf",
    "sparse_sampling",
    "timed_motion",
    "tree_levels",
    "ways_from",
    "worth_of_test",
]
