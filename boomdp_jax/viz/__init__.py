"""Pictures, still and moving, of scenes, posteriors and predictions."""

from boomdp_jax.viz.animation import animate as animate
from boomdp_jax.viz.figure import plot_posterior as plot_posterior
from boomdp_jax.viz.posteriors import draw_posterior as draw_posterior
from boomdp_jax.viz.predictions import draw_prediction as draw_prediction
from boomdp_jax.viz.scenes import draw_scene as draw_scene
from boomdp_jax.viz.search_trees import draw_tree as draw_tree
from boomdp_jax.viz.snapshots import draw as draw
from boomdp_jax.viz.structures import draw_structure_bars as draw_structure_bars

__all__ = [
    "animate",
    "draw",
    "draw_posterior",
    "draw_prediction",
    "draw_scene",
    "draw_structure_bars",
    "draw_tree",
    "plot_posterior",
]
