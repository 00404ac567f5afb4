"""A pure-JAX planar rigid-body engine whose stiff parts are solved implicitly."""

from boomdp_jax.physics.params import WORLD as WORLD
from boomdp_jax.physics.params import Distance as Distance
from boomdp_jax.physics.params import Ground as Ground
from boomdp_jax.physics.params import Params as Params
from boomdp_jax.physics.params import Revolute as Revolute
from boomdp_jax.physics.params import Wheel as Wheel
from boomdp_jax.physics.params import empty_params as empty_params
from boomdp_jax.physics.scene import Scene as Scene
from boomdp_jax.physics.scene_file import load_scene as load_scene
from boomdp_jax.physics.scene_file import save_scene as save_scene
from boomdp_jax.physics.scene_spec import SceneSpec as SceneSpec
from boomdp_jax.physics.scene_spec import scene_spec_from_dict as scene_spec_from_dict
from boomdp_jax.physics.state import State as State
from boomdp_jax.physics.state import state_from_array as state_from_array
from boomdp_jax.physics.step import StepInfo as StepInfo
from boomdp_jax.physics.step import prepare_step as prepare_step
from boomdp_jax.physics.step import rollout as rollout
from boomdp_jax.physics.step import step as step

__all__ = [
    "WORLD",
    "Distance",
    "Ground",
    "Params",
    "Revolute",
    "Scene",
    "SceneSpec",
    "State",
    "StepInfo",
    "Wheel",
    "empty_params",
    "load_scene",
    "prepare_step",
    "rollout",
    "save_scene",
    "scene_spec_from_dict",
    "state_from_array",
    "step",
]
