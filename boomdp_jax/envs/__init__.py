"""Tasks: a scene, the true numbers, a reward and a goal."""

from boomdp_jax.envs.acrobot import Acrobot as Acrobot
from boomdp_jax.envs.action_set import ActionSet as ActionSet
from boomdp_jax.envs.action_set import forces_round_circle as forces_round_circle
from boomdp_jax.envs.action_set import join_actions as join_actions
from boomdp_jax.envs.arm_clearance import ArmClearance as ArmClearance
from boomdp_jax.envs.arm_clearance import Held as Held
from boomdp_jax.envs.arm_control import Followed as Followed
from boomdp_jax.envs.arm_control import follow_motion as follow_motion
from boomdp_jax.envs.arm_control import take_hold as take_hold
from boomdp_jax.envs.arm_scene import ArmScene as ArmScene
from boomdp_jax.envs.arm_scene import arm_scene as arm_scene
from boomdp_jax.envs.blocking import Boxes as Boxes
from boomdp_jax.envs.blocking import stopped_by_boxes as stopped_by_boxes
from boomdp_jax.envs.cart import Cart as Cart
from boomdp_jax.envs.cart_worlds import CART_WORLDS as CART_WORLDS
from boomdp_jax.envs.cart_worlds import CartWorld as CartWorld
from boomdp_jax.envs.checked_room import check_room as check_room
from boomdp_jax.envs.environment import AbstractEnvironment as AbstractEnvironment
from boomdp_jax.envs.environment import EnvParams as EnvParams
from boomdp_jax.envs.environment import EnvState as EnvState
from boomdp_jax.envs.environment import PlanningHints as PlanningHints
from boomdp_jax.envs.free_space import FreeSpace as FreeSpace
from boomdp_jax.envs.free_space import PoseTable as PoseTable
from boomdp_jax.envs.free_space import pose_table as pose_table
from boomdp_jax.envs.grasp import GraspReport as GraspReport
from boomdp_jax.envs.grasp import Grip as Grip
from boomdp_jax.envs.grasp import grasping_step as grasping_step
from boomdp_jax.envs.grasp import open_grasp as open_grasp
from boomdp_jax.envs.living_room import LivingRoom as LivingRoom
from boomdp_jax.envs.manipulator_planner import ArmMotion as ArmMotion
from boomdp_jax.envs.manipulator_planner import Manipulation as Manipulation
from boomdp_jax.envs.manipulator_planner import ManipulatorPlanner as ManipulatorPlanner
from boomdp_jax.envs.mobile_arm import MobileArm as MobileArm
from boomdp_jax.envs.namo import NamoInfo as NamoInfo
from boomdp_jax.envs.namo import NamoReading as NamoReading
from boomdp_jax.envs.namo import NamoState as NamoState
from boomdp_jax.envs.namo import NamoWorld as NamoWorld
from boomdp_jax.envs.namo import grasped as grasped
from boomdp_jax.envs.namo import is_at_goal as is_at_goal
from boomdp_jax.envs.namo import make_world as make_world
from boomdp_jax.envs.namo import namo_step as namo_step
from boomdp_jax.envs.namo import with_delay as with_delay
from boomdp_jax.envs.namo_drive import Command as Command
from boomdp_jax.envs.namo_drive import drive as drive
from boomdp_jax.envs.namo_drive import going as going
from boomdp_jax.envs.namo_drive import pushing as pushing
from boomdp_jax.envs.namo_room import Robot as Robot
from boomdp_jax.envs.namo_room import Room as Room
from boomdp_jax.envs.namo_room import Thing as Thing
from boomdp_jax.envs.namo_room import room_params as room_params
from boomdp_jax.envs.namo_room import room_scene as room_scene
from boomdp_jax.envs.namo_rooms import is_solvable as is_solvable
from boomdp_jax.envs.namo_rooms import random_room as random_room
from boomdp_jax.envs.namo_rooms import story_room as story_room
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
    "ArmClearance",
    "ArmMotion",
    "ArmScene",
    "Boxes",
    "Cart",
    "CartWorld",
    "Command",
    "EnvParams",
    "EnvState",
    "Followed",
    "FreeSpace",
    "GraspReport",
    "Grip",
    "Held",
    "LivingRoom",
    "Manipulation",
    "ManipulatorPlanner",
    "MobileArm",
    "NamoInfo",
    "NamoReading",
    "NamoState",
    "NamoWorld",
    "Pendulum",
    "PlanningHints",
    "PoseTable",
    "Robot",
    "Room",
    "Thing",
    "Walls",
    "arm_scene",
    "check_room",
    "drive",
    "follow_motion",
    "forces_round_circle",
    "going",
    "grasped",
    "grasping_step",
    "is_at_goal",
    "is_solvable",
    "join_actions",
    "make_world",
    "namo_step",
    "open_grasp",
    "pose_table",
    "pushing",
    "random_room",
    "room_params",
    "room_scene",
    "stopped_at_walls",
    "stopped_by_boxes",
    "story_room",
    "take_hold",
    "walls_between",
    "way_to",
    "with_delay",
]
