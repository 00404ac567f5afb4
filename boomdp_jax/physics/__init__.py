"""A pure-JAX planar rigid-body engine whose stiff parts are solved implicitly."""

from boomdp_jax.physics.actuator import delayed_wrenches as delayed_wrenches
from boomdp_jax.physics.events import FirstTime as FirstTime
from boomdp_jax.physics.events import contact_flags as contact_flags
from boomdp_jax.physics.events import fell_over as fell_over
from boomdp_jax.physics.events import first_contact as first_contact
from boomdp_jax.physics.events import first_time as first_time
from boomdp_jax.physics.events import reached_region as reached_region
from boomdp_jax.physics.params import WORLD as WORLD
from boomdp_jax.physics.params import Actuator as Actuator
from boomdp_jax.physics.params import Distance as Distance
from boomdp_jax.physics.params import Ground as Ground
from boomdp_jax.physics.params import Params as Params
from boomdp_jax.physics.params import Prismatic as Prismatic
from boomdp_jax.physics.params import Revolute as Revolute
from boomdp_jax.physics.params import Surface as Surface
from boomdp_jax.physics.params import Weld as Weld
from boomdp_jax.physics.params import Wheel as Wheel
from boomdp_jax.physics.params import empty_params as empty_params
from boomdp_jax.physics.quantities import angular_momentum as angular_momentum
from boomdp_jax.physics.quantities import constraint_error as constraint_error
from boomdp_jax.physics.quantities import kinetic_energy as kinetic_energy
from boomdp_jax.physics.quantities import linear_momentum as linear_momentum
from boomdp_jax.physics.quantities import mass_and_inertia as mass_and_inertia
from boomdp_jax.physics.quantities import potential_energy as potential_energy
from boomdp_jax.physics.quantities import total_energy as total_energy
from boomdp_jax.physics.removal import remove_bodies as remove_bodies
from boomdp_jax.physics.scene import Scene as Scene
from boomdp_jax.physics.scene_file import load_scene as load_scene
from boomdp_jax.physics.scene_file import save_scene as save_scene
from boomdp_jax.physics.scene_spec import SceneSpec as SceneSpec
from boomdp_jax.physics.scene_spec import scene_spec_from_dict as scene_spec_from_dict
from boomdp_jax.physics.separation import pair_separation as pair_separation
from boomdp_jax.physics.separation import separation as separation
from boomdp_jax.physics.simulate import SimulationNoise as SimulationNoise
from boomdp_jax.physics.simulate import simulate as simulate
from boomdp_jax.physics.state import State as State
from boomdp_jax.physics.state import state_from_array as state_from_array
from boomdp_jax.physics.step import StepInfo as StepInfo
from boomdp_jax.physics.step import prepare_step as prepare_step
from boomdp_jax.physics.step import rollout as rollout
from boomdp_jax.physics.step import step as step
from boomdp_jax.physics.world_rollout import empty_cache as empty_cache

__all__ = [
    "WORLD",
    "Actuator",
    "Distance",
    "FirstTime",
    "Ground",
    "Params",
    "Prismatic",
    "Revolute",
    "Scene",
    "SceneSpec",
    "SimulationNoise",
    "State",
    "StepInfo",
    "Surface",
    "Weld",
    "Wheel",
    "angular_momentum",
    "constraint_error",
    "contact_flags",
    "delayed_wrenches",
    "empty_cache",
    "empty_params",
    "fell_over",
    "first_contact",
    "first_time",
    "kinetic_energy",
    "linear_momentum",
    "load_scene",
    "mass_and_inertia",
    "pair_separation",
    "potential_energy",
    "prepare_step",
    "reached_region",
    "remove_bodies",
    "rollout",
    "save_scene",
    "scene_spec_from_dict",
    "separation",
    "simulate",
    "state_from_array",
    "step",
    "total_energy",
]
