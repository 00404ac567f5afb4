"""Transition models that an agent can learn: physics, regressions, point fits."""

from boomdp_jax.models.features import BodyFeatures as BodyFeatures
from boomdp_jax.models.fixed_belief import FixedBelief as FixedBelief
from boomdp_jax.models.gaussian_process import GaussianProcess as GaussianProcess
from boomdp_jax.models.known_kinds import KnownKinds as KnownKinds
from boomdp_jax.models.linear import LinearRegression as LinearRegression
from boomdp_jax.models.locally_weighted import LocallyWeighted as LocallyWeighted
from boomdp_jax.models.metropolis_model import MetropolisModel as MetropolisModel
from boomdp_jax.models.model import AbstractModel as AbstractModel
from boomdp_jax.models.neural_ensemble import NeuralEnsemble as NeuralEnsemble
from boomdp_jax.models.object_among_others import (
    ObjectAmongOthers as ObjectAmongOthers,
)
from boomdp_jax.models.object_oriented import ObjectOriented as ObjectOriented
from boomdp_jax.models.outline_contact import touched_sectors as touched_sectors
from boomdp_jax.models.per_body import PerBody as PerBody
from boomdp_jax.models.per_body import ScenePhysics as ScenePhysics
from boomdp_jax.models.physics_model import PhysicsModel as PhysicsModel
from boomdp_jax.models.point_fit import CmaEs as CmaEs
from boomdp_jax.models.point_fit import GaussNewton as GaussNewton
from boomdp_jax.models.point_fit import PointFit as PointFit
from boomdp_jax.models.regression import AbstractRegressor as AbstractRegressor
from boomdp_jax.models.regression import BodyRegression as BodyRegression
from boomdp_jax.models.residual_model import ResidualPhysics as ResidualPhysics
from boomdp_jax.models.room_belief import FixedRoom as FixedRoom
from boomdp_jax.models.room_belief import LearntRoom as LearntRoom
from boomdp_jax.models.room_belief import RoomBelief as RoomBelief
from boomdp_jax.models.thing_belief import ThingModel as ThingModel
from boomdp_jax.models.thing_belief import kind_shares as kind_shares
from boomdp_jax.models.true_model import TrueModel as TrueModel

__all__ = [
    "AbstractModel",
    "AbstractRegressor",
    "BodyFeatures",
    "BodyRegression",
    "CmaEs",
    "FixedBelief",
    "FixedRoom",
    "GaussNewton",
    "GaussianProcess",
    "KnownKinds",
    "LearntRoom",
    "LinearRegression",
    "LocallyWeighted",
    "MetropolisModel",
    "NeuralEnsemble",
    "ObjectAmongOthers",
    "ObjectOriented",
    "PerBody",
    "PhysicsModel",
    "PointFit",
    "ResidualPhysics",
    "RoomBelief",
    "ScenePhysics",
    "ThingModel",
    "TrueModel",
    "kind_shares",
    "touched_sectors",
]
