"""Tasks: a scene, the true numbers, a reward and a goal."""

from boomdp_jax.envs.acrobot import Acrobot as Acrobot
from boomdp_jax.envs.action_set import ActionSet as ActionSet
from boomdp_jax.envs.action_set import forces_round_circle as forces_round_circle
from boomdp_jax.envs.action_set import join_actions as join_actions
from boomdp_jax.envs.blocking import Boxes as Boxes
from boomdp_jax.envs.blocking import stopped_by_boxes as stopped_by_boxes
from boomdp_jax.envs.cart import Cart as Cart
from boomdp_jax.envs.cart_worlds import CART_WORLDS as CART_WORLDS
from boomdp_jax.envs.cart_worlds import CartWorld as CartWorld
from boomdp_jax.envs.environment import AbstractEnvironment as AbstractEnvironment
from boomdp_jax.envs.environment import EnvParams as EnvParams
from boomdp_jax.envs.environment import EnvState as EnvState
from boomdp_jax.envs.environment import PlanningHints as PlanningHints
from boomdp_jax.envs.living_room import LivingRoom as LivingRoom
from boomdp_jax.envs.pendulum import Pendulum as Pendulum
from boomdp_jax.envs.walls import Walls as Walls
from boomdp_jax.envs.walls import stopped_at_walls as stopped_at_walls
from boomdp_jax.envs.walls import walls_between as walls_between
from boomdp_jax.envs.ways import way_to as way_to

__all__ = [
    "CART_WORLDS",
    "AbstractEnvironment",
    "Acrobot",
    "ActionSet",
    "Boxes",
    "Cart",
    "CartWorld",
    "EnvParams",
    "EnvState",
    "LivingRoom",
    "Pendulum",
    "PlanningHints",
    "Walls",
    "forces_round_circle",
    "join_actions",
    "stopped_at_walls",
    "stopped_by_boxes",
    "walls_between",
    "way_to",
]
